"""Responses of a study: metrics and required ground truth.

A missing response raises a ``ConfigError``, an unsuitable recording a ``DatasetError``.
"""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from dudmap.errors import ConfigError, DatasetError
from dudmap.lab.study.designs import Table

if TYPE_CHECKING:
    from dudmap.io.sequences import Sequence
    from dudmap.lab.benchmark.suites import Entry


class Response(NamedTuple):
    """One response with name and unit.

    Attributes:
        key: In a row of ``dudmap.lab.benchmark.measure``.
        better: Low or high.
        needs: Required ground truth.
    """

    key: str
    name: str
    unit: str = ""
    factor: float = 1.0
    better: Literal["low", "high"] = "low"
    needs: Literal["", "truth", "masks", "surface"] = ""

    @property
    def heading(self) -> str:
        """Name with unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


RESPONSES = {
    "ate": Response("ate_rmse_m", "ATE RMSE", "mm", 1000, needs="truth"),
    "rpe": Response("rpe_trans_rmse_m_per_s", "RPE", "mm/s", 1000, needs="truth"),
    "mask_iou": Response("mask_iou_mean", "mask IoU", better="high", needs="masks"),
    "mesh_accuracy": Response("mesh_accuracy_m", "mesh accuracy", "mm", 1000, needs="surface"),
    "completeness": Response("mesh_completeness", "mesh completeness", better="high", needs="surface"),
    "ghosts": Response("ghost_share", "ghost share of the mesh", needs="surface"),
    "lost": Response("lost", "lost frames"),
    "ms": Response("ms_per_frame_median", "time per frame", "ms"),
    "memory": Response("peak_rss_mb", "peak memory", "MB"),
}
"""Responses by name (``docs/evaluation.md``)."""


class Scale(NamedTuple):
    """Analysis of a response, plain or logarithmic."""

    response: str
    log: bool = False

    @property
    def heading(self) -> str:
        """Name with unit."""
        return f"log of {RESPONSES[self.response].heading}" if self.log else RESPONSES[self.response].heading

    @property
    def sign(self) -> int:
        """1 if low values are good, -1 if high ones are."""
        return 1 if RESPONSES[self.response].better == "low" else -1

    def plain(self, value: float) -> float:
        """Analysed value in the response's unit."""
        return float(np.exp(value)) if self.log else float(value)

    @property
    def unit(self) -> str:
        """Unit of an analysed value."""
        return " of the logarithm" if self.log else f" {RESPONSES[self.response].unit}".rstrip()

    def text(self, value: float) -> str:
        """Analysed value in words: four digits, with its unit."""
        return f"{self.plain(value):.4g} {RESPONSES[self.response].unit}".rstrip()

    def usable(self, table: Table) -> Table:
        """Runs with the response, under its name."""
        name, response = self.response, RESPONSES[self.response]
        if response.key not in table or table[response.key].isna().all():
            errors = list(table["error"].dropna()) if "error" in table else []
            reason = f"; the first error: {errors[0]}" if errors else ""
            raise ConfigError(f"no run has the response {name}{reason}")
        out = table[table[response.key].notna()].reset_index(drop=True)
        out[name] = response.factor * out[response.key].astype(float)
        if self.log and (out[name] <= 0).any():
            raise ConfigError(f"the response {name} is 0 in some runs and has no logarithm there; take it out of log")
        return out.assign(**{name: np.log(out[name])}) if self.log else out


def check_truth(entry: "Entry", sequence: "Sequence", names: tuple[str, ...]) -> None:
    """Check a recording's ground truth for responses."""
    for name in names:
        needs, lacking = RESPONSES[name].needs, ""
        if needs in ("truth", "surface") and sequence.ground_truth is None:
            lacking = "no true trajectory"
        elif needs == "masks" and not _has_masks(entry, sequence):
            lacking = "no true masks of anything that moves"
        elif needs == "surface" and entry.path is not None and entry.surfaces(sequence) is None:
            lacking = "no true surface (surface.ply)"
        if lacking:
            raise DatasetError(f"{entry.name} has {lacking}, which the response {name} needs")
        if name == "rpe" and np.ptp(sequence.timestamps) < 1:
            raise DatasetError(f"{entry.name} is shorter than one second, the interval of the response rpe")


def _has_masks(entry: "Entry", sequence: "Sequence") -> bool:
    if entry.path is None:
        return bool(getattr(sequence, "parameters", {}).get("movers"))
    return sequence.mask(0) is not None
