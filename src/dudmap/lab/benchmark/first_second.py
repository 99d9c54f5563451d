"""Errors of the first frames of a map, whose surfaces few frames have averaged, against exact poses."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.slam import Slam
from dudmap.errors import DatasetError
from dudmap.io.sequences import Sequence

FRAMES = 30
"""Number of frames, one second of most sensors."""
SHOWN = (1, 2, 5, 10, 20, 29)
"""Frames of the table; the first one defines the world frame and has no error."""
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
    """Track the first frames by distances only, as configured, and by colour almost only.

    Both trajectories begin with the first camera: what its noise does to the world frame is no error.

    Raises:
        DatasetError: The recording has no true poses.
    """
    truth = sequence.ground_truth
    if truth is None:
        raise DatasetError(f"{sequence.name} has no true poses; benchmark first-second needs them")
    weight = config.tracker.color_weight
    found = []
    for term, color_weight in (("distances", 0.0), ("both", weight), ("colour", MOSTLY_COLOR * weight)):
        slam = Slam(sequence.camera, config.override([f"tracker.color_weight={color_weight}"]))
        errors = np.full((frames, 2), np.nan)
        T_world_first = np.eye(4)
        for index in range(min(frames, len(sequence))):
            T_true = truth.interpolate(float(sequence.timestamps[index]))
            T_world_first = se3.inverse(T_true) if index == 0 else T_world_first
            T = slam.process(sequence[index]).T_world_camera
            if T is not None:
                error = se3.inverse(T_world_first @ T_true) @ T
                angle = np.linalg.norm(se3.log_rotation(error[:3, :3]))
                errors[index] = np.degrees(angle), 1000 * np.linalg.norm(error[:3, 3])
        found.append(FirstSecond(term, errors[:, 0], errors[:, 1]))
    return found


def first_second_table(runs: list[list[FirstSecond]]) -> str:
    """Markdown table of the root mean square errors over runs, degrees and millimetres per frame."""
    shown = [n for n in SHOWN if n < len(runs[0][0].rotation_deg)]
    lines = ["| term | " + " | ".join(f"frame {n}" for n in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    for column in zip(*runs, strict=True):
        rotation = np.sqrt(np.nanmean([run.rotation_deg**2 for run in column], axis=0))
        translation = np.sqrt(np.nanmean([run.translation_mm**2 for run in column], axis=0))
        cells = [f"{rotation[n]:.3f} deg, {translation[n]:.2f} mm" for n in shown]
        lines.append(f"| {column[0].term} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
