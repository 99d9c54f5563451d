"""Responses of a study: which figure of a run each stands for, and what a recording must have for it."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from dudmap.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence
    from dudmap.lab.benchmark.entries import Entry


class Response(NamedTuple):
    """One response.

    Attributes:
        key: Key of the figure in a row of ``dudmap.lab.benchmark.measure``.
        heading: Name with unit.
        better: Whether low or high values are good.
        needs: What the recording must have.
    """

    key: str
    heading: str
    better: Literal["low", "high"] = "low"
    needs: Literal["", "truth", "masks", "surface"] = ""


RESPONSES = {
    "ate": Response("ate_rmse_m", "ATE RMSE, m", needs="truth"),
    "rpe": Response("rpe_trans_rmse_m_per_s", "RPE, m/s", needs="truth"),
    "mask_iou": Response("mask_iou_mean", "mask IoU", "high", "masks"),
    "mesh_accuracy": Response("mesh_accuracy_m", "mesh accuracy, m", needs="surface"),
    "completeness": Response("mesh_completeness", "mesh completeness", "high", "surface"),
    "ghosts": Response("ghost_share", "ghost share of the mesh", needs="surface"),
    "lost": Response("lost", "lost frames"),
    "ms": Response("ms_per_frame_median", "ms per frame"),
    "memory": Response("peak_rss_mb", "peak memory, MB"),
}
"""Responses by name; ``docs/evaluation.md`` defines the figures."""


def known_responses(names: object) -> tuple[str, ...]:
    """Checked names of responses.

    Raises:
        ConfigError: There is none, or one is unknown.
    """
    if not isinstance(names, list) or not names:
        raise ConfigError(f"responses is {names!r}; expected a list of {', '.join(RESPONSES)}")
    for name in names:
        if name not in RESPONSES:
            raise ConfigError(f"unknown response {name!r}; known are {', '.join(RESPONSES)}")
    return tuple(dict.fromkeys(names))


def check_truth(entry: "Entry", sequence: "Sequence", names: tuple[str, ...]) -> None:
    """Check that a recording has the truth that the responses need.

    Raises:
        DatasetError: It has not.
    """
    for name in names:
        needs = RESPONSES[name].needs
        if needs in ("truth", "surface") and sequence.ground_truth is None:
            raise DatasetError(f"{entry.name} has no true trajectory, which the response {name} needs")
        if name == "rpe" and np.ptp(sequence.timestamps) < 1:
            raise DatasetError(f"{entry.name} is shorter than one second, the interval of the response rpe")
        if needs == "masks" and not _has_masks(entry, sequence):
            raise DatasetError(
                f"{entry.name} has no true masks of anything that moves, which the response {name} needs"
            )
        if needs == "surface" and entry.path is not None and entry.surfaces(sequence) is None:
            raise DatasetError(f"{entry.name} has no true surface (surface.ply), which the response {name} needs")


def _has_masks(entry: "Entry", sequence: "Sequence") -> bool:
    if entry.path is None:
        return bool(getattr(sequence, "parameters", {}).get("movers"))
    return sequence.mask(0) is not None
