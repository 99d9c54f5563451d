"""Systematic errors of the registration: the mean pull of each term at the true pose, and the first frames of a map."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, Pyramid, exposed
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.slam import Slam
from dudmap.core.tracking.tracker import STOP, Tracker
from dudmap.io.sequences import Sequence

ITERATIONS = 8
"""Gauss-Newton steps of each registration."""
DAMPING = 1e-4
"""Damping relative to the diagonal of H, which only keeps unconstrained directions from drifting."""


def measure_pulls(sequence: Sequence, config: Config, stride: int = 1) -> dict[str, NDArray[np.float64]]:
    """Fuse a static recording at its true poses, then register every ``stride``-th frame from its true pose.

    This shows systematic errors, which neither residuals nor the ATE of a run show separately: where images, poses and
    clocks are exact, every mean correction must vanish.

    The world frame is the first camera's, as in a run. Frames without a true pose are left out.

    Returns:
        Corrections (n, 6) of the n poses by ``distances``, ``colour`` and ``both``: translation (mm) and rotation
            vector (deg), camera axes.
    """
    truth = sequence.ground_truth
    assert truth is not None
    preprocess = Preprocessor(sequence.camera, config.preprocess)
    volume = TsdfVolume(preprocess.camera, config.volume, config.sensor, config.preprocess.depth_max)
    frames: list[tuple[Level, NDArray[np.float64]]] = []
    for index, stamp in enumerate(sequence.timestamps):
        if not truth.timestamps[0] <= stamp <= truth.timestamps[-1]:
            continue
        observation = preprocess(sequence[index])
        T_truth = truth.interpolate(float(stamp))
        T_first = frames[0][1] if frames else T_truth
        volume.integrate(
            Frame(observation.timestamp, observation.depth, observation.rgb), se3.inverse(T_first) @ T_truth
        )
        frames.append((Pyramid.of(observation, preprocess.camera, config).fine, T_truth))
    tracker = Tracker(config.tracker, config.sensor, config.preprocess.smoothing_px)
    T_world_first = se3.inverse(frames[0][1])
    corrections: dict[str, list[NDArray[np.float64]]] = {"distances": [], "colour": [], "both": []}
    for level, T_truth in frames[::stride]:
        T_true = T_world_first @ T_truth
        volume.look_at(T_true)
        weights = np.ones_like(level.depth)
        differences = tracker.linearize(volume, level, T_true, weights).residuals[1]
        lit = exposed(level, fit_exposure(level.intensity, differences, weights))
        for term, found in corrections.items():
            correction = se3.inverse(T_true) @ _registered(tracker, volume, lit, T_true, term)
            rotation = np.degrees(se3.log_rotation(correction[:3, :3]))
            found.append(np.concatenate([1000 * correction[:3, 3], rotation]))
    return {term: np.array(found) for term, found in corrections.items()}


def _registered(
    tracker: Tracker, volume: TsdfVolume, level: Level, T: NDArray[np.float64], term: str
) -> NDArray[np.float64]:
    """Pose (4, 4) that one term of the cost, or both, wants, by Gauss-Newton from ``T``."""
    weights = np.ones_like(level.depth)
    for _ in range(ITERATIONS):
        both = tracker.linearize(volume, level, T, weights)
        distances = tracker.linearize(volume, level, T, weights, color_weight=0.0)
        H, b = {
            "distances": (distances.H, distances.b),
            "colour": (both.H - distances.H, both.b - distances.b),
            "both": (both.H, both.b),
        }[term]
        diagonal = np.diag(H)
        damped = H + np.diag(DAMPING * diagonal + 1e-12 * (1 + diagonal.max()))
        step = np.asarray(-np.linalg.solve(damped, b), dtype=np.float64)
        T = se3.retract(T, step)
        if np.linalg.norm(step) < STOP / 10:
            break
    return T


FRAMES = 30
"""Number of frames, one second of most sensors."""
MOSTLY_COLOR = 100.0
"""Factor of the colour weight with which distances hardly count."""


class FirstSecond(NamedTuple):
    """Errors of one run.

    Attributes:
        term: ``distances``, ``both`` or ``colour``.
        rotation_deg, translation_mm: (n,) per frame, NaN where it is lost.
    """

    term: str
    rotation_deg: NDArray[np.float64]
    translation_mm: NDArray[np.float64]


def measure_first_second(sequence: Sequence, config: Config, frames: int = FRAMES) -> list[FirstSecond]:
    """Track the first frames by distances only, as configured, and by colour almost only; of the final trajectory.

    Both trajectories begin with the first camera: what its noise does to the world frame is no error.
    """
    truth = sequence.ground_truth
    assert truth is not None
    weight = config.tracker.color_weight
    found = []
    for term, color_weight in (("distances", 0.0), ("both", weight), ("colour", MOSTLY_COLOR * weight)):
        slam = Slam(sequence.camera, config.override([f"tracker.color_weight={color_weight}"]))
        for index in range(min(frames + 1, len(sequence))):  # with the next frame the first poses are estimated again
            slam.process(sequence[index])
        poses = {pose.timestamp: pose.T_world_camera for pose in slam.atlas.poses}
        stamps, errors = sequence.timestamps[:frames].tolist(), np.full((frames, 2), np.nan)
        T_world_first = se3.inverse(truth.interpolate(stamps[0]))
        for index, stamp in enumerate(stamps):
            if stamp in poses:
                error = se3.inverse(T_world_first @ truth.interpolate(stamp)) @ poses[stamp]
                angle = np.linalg.norm(se3.log_rotation(error[:3, :3]))
                errors[index] = np.degrees(angle), 1000 * np.linalg.norm(error[:3, 3])
        found.append(FirstSecond(term, errors[:, 0], errors[:, 1]))
    return found
