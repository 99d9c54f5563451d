"""Time offset between two trajectories of one camera, from its motion."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import LARGEST_STEP, Trajectory
from dudmap.errors import DatasetError

Numbers = NDArray[np.float64]

STEP = LARGEST_STEP / 3
"""Step of the first search, seconds: three within steady motion."""
GRID = STEP / 5
"""Step of the reference's rotations, seconds: motion capture."""
WINDOW = 2 * LARGEST_STEP
"""Time of compared rotations, seconds."""
SAMPLES = 300
"""Compared poses of the estimate."""
SMALLEST_OVERLAP = 0.5
"""Smallest share of the estimate within the reference's time."""
CHUNK = 1000
"""Offsets compared at a time: 30 MB."""
LARGEST_HINT = CHUNK * STEP / 2
"""Largest offset for a hint, seconds: 0.2 s of search."""


class TimeOffset(NamedTuple):
    """Seconds to add to the estimate, and unexplained share of the motion:

    ``1 - r^2``, 0 for equal motions, 1 for unrelated ones, with the correlation r of aligned positions or angles of
    rotation, or the mean of both.
    """

    seconds: float
    unexplained: float


class MotionComparison:
    """Compares motions at any time offset, independent of world frame, body frame and scale.

    Raises:
        DatasetError: Fewer than two poses.
    """

    def __init__(self, estimate: Trajectory, reference: Trajectory) -> None:
        if min(len(estimate), len(reference)) < 2:
            raise DatasetError("a trajectory of one pose has no motion; no time offset can be found")
        chosen = np.unique(np.linspace(0, len(estimate) - 1, SAMPLES).astype(int))
        self.times, self.positions = estimate.timestamps[chosen], estimate.Ts_world_camera[chosen, :3, 3]
        self.turns = _turns(estimate, self.times)
        self.reference = reference
        start, stop = reference.timestamps[[0, -1]]
        self.grid = np.linspace(start, stop, max(2, 1 + int(np.ceil((stop - start) / GRID))))
        self.grid_turns = _turns(reference, self.grid)

    def best(self, largest: float = np.inf) -> TimeOffset:
        """Best offset of at most ``largest`` seconds with half of the estimate in the reference's time.

        Raises:
            DatasetError: No such offset, or no motion.
        """
        start, stop = self.reference.timestamps[0] - self.times[-1], self.reference.timestamps[-1] - self.times[0]
        offsets = np.arange(max(start, -largest), min(stop, largest) + STEP, STEP)
        parts = np.split(offsets, range(CHUNK, len(offsets), CHUNK))
        found = np.concatenate([self._unexplained(part) for part in parts])
        if not np.isfinite(found).any():
            raise DatasetError(
                "no time offset can be found: fewer than half of the estimated poses fit into the time of the "
                "reference, or one of the two does not move; give --time-offset SECONDS"
            )
        near = float(offsets[np.argmin(found)])
        step = minimize_scalar(lambda step: min(self.at(near + step), 1.0), bounds=(-STEP, STEP), method="bounded").x
        seconds = min(near, near + float(step), key=self.at)
        return TimeOffset(seconds, self.at(seconds))

    def at(self, seconds: float) -> float:
        """Unexplained share of the motion; infinite if unknown."""
        return float(self._unexplained(np.array([seconds]))[0])

    def _unexplained(self, offsets: Numbers) -> Numbers:
        known = self.reference.timestamps
        times = self.times + offsets[:, None]
        weights = ((times >= known[0]) & (times <= known[-1])).astype(np.float64)
        enough = weights.mean(axis=1) >= SMALLEST_OVERLAP
        axes = self.reference.Ts_world_camera[:, :3, 3].T
        places = np.stack([np.interp(times, known, axis) for axis in axes], axis=-1)
        turns = np.interp(times, self.grid, self.grid_turns)
        both = weights * np.isfinite(turns + self.turns)
        shares = np.stack([
            _unrelated(places, np.broadcast_to(self.positions, places.shape), weights),
            _unrelated(np.nan_to_num(turns)[..., None], np.nan_to_num(self.turns)[None, :, None], both),
        ])  # fmt: skip
        defined = np.isfinite(shares)
        mean = np.where(defined, shares, 0).sum(axis=0) / np.maximum(defined.sum(axis=0), 1)
        return np.where(enough & defined.any(axis=0), mean, np.inf)


def _unrelated(a: Numbers, b: Numbers, weights: Numbers) -> Numbers:
    total = np.maximum(weights.sum(axis=1), 1)[:, None, None]
    w = weights[..., None]
    a, b = (w * (points - (w * points).sum(axis=1, keepdims=True) / total) for points in (a, b))
    H = np.swapaxes(a, 1, 2) @ b
    singular = np.linalg.svd(H, compute_uv=False)
    if H.shape[-1] == 3:
        singular[:, 2] *= np.sign(np.linalg.det(H))  # -1 if the best orthogonal matrix is a reflection
    else:
        singular = H[..., 0]  # no rotation of scalars: their correlation keeps its sign
    spreads = (a**2).sum(axis=(1, 2)) * (b**2).sum(axis=(1, 2))
    r = np.maximum(singular.sum(axis=1), 0) / np.sqrt(np.where(spreads > 0, spreads, np.nan))
    return 1 - r**2


def _turns(trajectory: Trajectory, times: Numbers) -> Numbers:
    """Angles by which the camera turns in ``WINDOW`` seconds after given times, radians; NaN near the end."""
    Ts, stamps = trajectory.Ts_world_camera, trajectory.timestamps
    motions = se3.log_all(se3.inverse(Ts[:-1]) @ Ts[1:])

    def at(moments: Numbers) -> Numbers:
        before = np.clip(np.searchsorted(stamps, moments, side="right") - 1, 0, len(stamps) - 2)
        shares = (moments - stamps[before]) / (stamps[before + 1] - stamps[before])
        return Ts[before] @ se3.exp_all(np.clip(shares, 0, 1)[:, None] * motions[before])

    angles = se3.rotation_angles(se3.inverse(at(times)) @ at(times + WINDOW))
    return np.where(times + WINDOW <= stamps[-1], angles, np.nan)
