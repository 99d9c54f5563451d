"""Figures of one result against the truth, whoever computed it."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap import se3
from dudmap.metrics import accuracy
from dudmap.trajectory import Trajectory

if TYPE_CHECKING:
    from dudmap.mesh import Mesh

LARGEST_GAP = 0.02
"""A true pose counts for a time at most this far outside the ground truth's rows, seconds."""


def score_trajectory(estimate: Trajectory, truth: Trajectory | None) -> dict[str, Any]:
    """ATE and RPE (see ``dudmap.evaluation``), and the errors when only the first pose is aligned.

    ``drift_rmse_m`` and ``rotation_rmse_deg`` compare the motion since the first pose: translation and angle of
    inv(T_true_first) T_true against inv(T_first) T, root mean square over all poses.
    """
    if truth is None or not len(estimate):
        return {}
    out = accuracy(estimate, truth)
    pairs = matched(estimate, truth)
    if pairs is not None:
        Ts, Ts_true = (se3.inverse(poses[0]) @ poses for poses in pairs)
        shift = Ts[:, :3, 3] - Ts_true[:, :3, 3]
        angles = [se3.rotation_angle(se3.inverse(a) @ b) for a, b in zip(Ts, Ts_true, strict=True)]
        out["drift_rmse_m"] = round(float(np.sqrt(np.mean(np.sum(shift**2, axis=1)))), 6)
        out["rotation_rmse_deg"] = round(float(np.degrees(np.sqrt(np.mean(np.square(angles))))), 5)
    return out


def matched(estimate: Trajectory, truth: Trajectory) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Estimated poses (N, 4, 4) within the truth's time, and the true ones interpolated to their times."""
    first, last = truth.timestamps[0], truth.timestamps[-1]
    stamps = estimate.timestamps
    inside = (stamps >= first - LARGEST_GAP) & (stamps <= last + LARGEST_GAP)
    if not inside.any():
        return None
    Ts_true = np.array([truth.interpolate(min(max(t, first), last)) for t in stamps[inside]])
    return estimate.Ts_world_camera[inside], Ts_true


def into_true_world(mesh: "Mesh", estimate: Trajectory, truth: Trajectory) -> "Mesh | None":
    """The mesh moved by the transformation that makes the first pose the true one; None without a common time."""
    from dudmap.mesh import Mesh

    pairs = matched(estimate, truth)
    if pairs is None:
        return None
    T = pairs[1][0] @ se3.inverse(pairs[0][0])
    return Mesh(
        (mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        mesh.faces,
        mesh.colors,
        (mesh.normals @ T[:3, :3].T).astype(np.float32),
    )
