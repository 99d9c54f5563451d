"""Causes of trajectory errors besides the estimate: clocks, or poses of another body."""

from math import degrees

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.evaluation.time_offset import LARGEST_HINT, MotionComparison
from dudmap.evaluation.trajectory import adjusted, ate, body_rotation

EXPLAINED = 0.5
"""Largest remaining share of an explained error, below noise's by three degrees of freedom."""


def hints(estimate: Trajectory, reference: Trajectory, max_difference: float) -> list[str]:
    """Sentences on causes of at least half of the error, and their options."""
    found = _of_time(estimate, reference, max_difference), _of_body(estimate, reference, max_difference)
    return [hint for hint in found if hint]


def _of_time(estimate: Trajectory, reference: Trajectory, max_difference: float) -> str:
    before = ate(estimate, reference, max_difference=max_difference)
    try:
        motions = MotionComparison(estimate, reference)
        best = motions.best(LARGEST_HINT)
        after = ate(adjusted(estimate, best.seconds), reference, max_difference=max_difference)
    except DatasetError:  # no other offset can be compared, so none explains the error
        return ""
    if best.unexplained > EXPLAINED**2 * motions.at(0.0) or after.rmse >= before.rmse:
        return ""
    return (
        f"the clocks seem to differ: with {best.seconds:+.3f} s on the times of the estimate the motions agree, and "
        f"the ATE is {1000 * after.rmse:.1f} instead of {1000 * before.rmse:.1f} mm; give --time-offset auto"
    )


def _of_body(estimate: Trajectory, reference: Trajectory, max_difference: float) -> str:
    try:
        R, before, after = body_rotation(estimate, reference, max_difference)
    except DatasetError:  # too short for rotations per second
        return ""
    if after > EXPLAINED * before:
        return ""
    angle = degrees(se3.rotation_angle(R))
    return (
        f"the reference seems to hold poses of another body than the camera, turned by {angle:.0f} deg: without this "
        f"turn the rotational RPE is {after:.2f} instead of {before:.2f} deg/s; convert the reference into camera "
        "poses, else only the ATE has a meaning"
    )
