"""How far a trajectory is off, so that a tracker which never moves fails every test that asks."""

import numpy as np

from dudmap.core.geometry import se3

LIMIT = 0.15
"""Largest share of the motion that an error in a test may have."""


def off_course(Ts_true: np.ndarray, Ts_found: list[np.ndarray | None]) -> float:
    """Largest error of the positions found, as a share of the largest distance that the camera moved from the first of
    the poses, with which both begin: 1 for a tracker that never moves. Poses that are None are left out."""
    Ts_true = se3.inverse(Ts_true[0]) @ Ts_true
    pairs = [(T, T_found) for T, T_found in zip(Ts_true, Ts_found, strict=False) if T_found is not None]
    errors = [np.linalg.norm(T[:3, 3] - T_found[:3, 3]) for T, T_found in pairs]
    return float(max(errors) / max(np.linalg.norm(T[:3, 3]) for T, _ in pairs))
