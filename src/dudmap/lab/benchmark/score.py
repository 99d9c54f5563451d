"""Errors of a trajectory and a mesh, of any system, against the ground truth."""

from typing import TYPE_CHECKING, Any

from dudmap.core.geometry.trajectory import Trajectory
from dudmap.evaluation.trajectory import RUN_FIGURES, accuracy, ate

if TYPE_CHECKING:
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.evaluation.surface import Surface

COMPLETE_WITHIN = 0.02
"""Largest distance to the mesh of a point of the true surface that counts as reconstructed, metres."""
SAMPLES = 100_000
"""Number of points sampled on each surface."""


def score_trajectory(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """ATE, RPE, and the drift after aligning the first pose only; see ``evaluation.trajectory.trajectory_figures``."""
    return accuracy(estimate, truth, (*RUN_FIGURES, "drift_rmse_m", "rotation_rmse_deg"))


def score_mesh(
    mesh: "Mesh",
    estimate: Trajectory,
    truth: Trajectory,
    whole: "Mesh | Surface",
    seen: "Mesh | Surface",
    samples: int = SAMPLES,
) -> dict[str, Any]:
    """Accuracy, completeness and ghosts of a mesh.

    The mesh is aligned by the first pose only, so that a bent or shifted map is penalised.

    Args:
        mesh: Estimated mesh in the world frame of ``estimate``.
        estimate: Estimated trajectory.
        truth: True trajectory.
        whole: True static surface in the world frame of ``truth``, for accuracy and ghosts.
        seen: Part of it that the camera saw, for completeness.
        samples: Number of points sampled on each surface.

    Raises:
        DatasetError: The trajectories have fewer than three poses in common.
        MapError: A mesh has no faces.
    """
    from dudmap.evaluation.reconstruction import compare_surfaces
    from dudmap.evaluation.surface import moved

    T = ate(estimate, truth, align="origin").T_reference_estimate
    result = compare_surfaces(moved(mesh, T), whole, observed=seen, thresholds=(COMPLETE_WITHIN,), samples=samples)
    return {
        "mesh_accuracy_m": round(result.accuracy.mean, 6),
        "mesh_completeness": round(result.scores[0].recall, 5),
        "ghost_area_m2": None if result.ghost_area_m2 is None else round(result.ghost_area_m2, 5),
        "ghost_share": round(result.ghost_share, 5),
    }
