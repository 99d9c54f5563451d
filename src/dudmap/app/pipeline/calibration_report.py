"""What is known of a colour camera, in sentences: what the images were asked, how certainly, and what is assumed."""

from typing import TYPE_CHECKING

import numpy as np

from dudmap.core.calibration.estimator import EVIDENCE, GROUPS, MIN_PAIRS, TRANSLATION
from dudmap.core.geometry.calibration import PARAMETERS, Calibration

if TYPE_CHECKING:
    from dudmap.core.calibration.estimator import Estimate

UNITS = {
    "translation": ("mm", 1000.0),
    "rotation": ("deg", 57.29578),
    "log_focal": ("%", 100.0),
    "center": ("px", 1.0),
    "k1": ("", 1.0),
    "k2": ("", 1.0),
    "delay": ("ms", 1000.0),
    "readout": ("ms", 1000.0),
}
"""Unit of each kind of parameter in texts, and how many there are in a metre, radian, pixel or second."""
ASSUMED = "assumed as given, not tested"
"""What is said of a colour camera that no image was asked about."""


def kind_of(parameter: str) -> str:
    """The kind of a parameter, a key of ``UNITS``: all axes of a translation are one kind."""
    return parameter.rpartition("_")[0] if parameter[-2:] in ("_x", "_y", "_z") else parameter


def findings(estimate: "Estimate") -> list[str]:
    """One sentence per group of parameters: estimated, tested and kept, or assumed, and the standard deviations."""
    out = []
    for name, members in GROUPS.items():
        evidence, known = estimate.evidence[name], _sigma(estimate.calibration, name)
        if np.isnan(evidence):
            said = f"{ASSUMED}: fewer than {MIN_PAIRS} pairs of overlapping views in half of the time"
        elif members[0] in estimate.calibration.estimated:
            said = f"estimated; other images fit {evidence:.1f} standard errors better; standard deviations {known}"
        elif evidence >= EVIDENCE:
            said = (
                f"assumed as given; tested: other values fit {evidence:.1f} standard errors better, but by too small a "
                f"share to be used; standard deviations {known}"
            )
        else:
            said = (
                f"assumed as given; tested: other values are not proven ({evidence:+.1f} standard errors, {EVIDENCE:g} "
                f"are needed); standard deviations, if they are nearly right, {known}"
            )
        out.append(f"colour camera, {name}: {said}")
    return out


def _sigma(calibration: Calibration, group: str) -> str:
    """Standard deviations of the parameters of a group, of several axes the largest, as text."""
    largest: dict[str, float] = {}
    for name, sigma in zip(PARAMETERS, calibration.sigma, strict=True):
        if name in GROUPS[group] or (group == "geometry" and name in TRANSLATION):
            largest[kind_of(name)] = max(largest.get(kind_of(name), 0.0), float(sigma))
    said = []
    for kind, sigma in largest.items():
        unit, factor = UNITS[kind]
        value = f"{factor * sigma:.2g} {unit}".strip() if np.isfinite(sigma) else "unknown"
        said.append(f"{kind.replace('log_focal', 'focal length')} {value}")
    return ", ".join(said)
