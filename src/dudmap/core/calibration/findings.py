"""Sentences on a calibration: its outcome, and one per group of parameters."""

from dataclasses import replace

import numpy as np

from dudmap.core.calibration.estimator import SHUTTER, SHUTTER_PARAMETER, TESTED, Estimate
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera

UNITS = {
    "translation": ("mm", 1000.0),
    "rotation": ("deg", 57.29578),
    "log_focal": ("%", 100.0),
    "center": ("px", 1.0),
    "k1": ("", 1.0),
    "k2": ("", 1.0),
    "delay": ("ms", 1000.0),
    "readout": ("ms", 1000.0),
    "vignetting": ("%", 100.0),
    "depth_readout": ("ms", 1000.0),
}
"""Display unit of each kind of parameter, and units per SI unit."""
ASSUMED = "assumed as given, not tested"
"""Finding on an untested colour camera."""


def kind_of(parameter: str) -> str:
    """Kind of a parameter, a key of ``UNITS``."""
    return parameter.rpartition("_")[0] if parameter[-2:] in ("_x", "_y", "_z") else parameter


def findings(estimate: "Estimate") -> list[str]:
    """One sentence per group of parameters: estimated or assumed, test result, and standard deviations."""
    out = [_shutter_finding(estimate)]
    for name, members in TESTED.items():
        verdict, known = estimate.verdicts[name], _sigma(estimate.calibration, members)
        evidence = verdict.figure("evidence")
        if np.isnan(evidence):
            said = f"{ASSUMED}: {verdict.reason}"
        elif members[0] in estimate.calibration.estimated:
            said = f"estimated; other images fit {evidence:.1f} standard errors better; standard deviations {known}"
        else:
            known = f"standard deviations, if the given values are nearly right, {known}"
            said = f"assumed as given; tested: {verdict.reason}; {known}"
        out.append(f"colour camera, {name}: {said}")
    return out


def _shutter_finding(estimate: "Estimate") -> str:
    verdict, readout = estimate.verdicts[SHUTTER], 1000 * estimate.calibration.depth_readout
    evidence = verdict.figure("evidence")
    taken = f"rows are taken to be read out within {readout:.1f} ms"
    if np.isnan(evidence):
        said = f"{ASSUMED}: {verdict.reason}"
    elif SHUTTER_PARAMETER in estimate.calibration.estimated:
        said = f"estimated; other images fit {evidence:.1f} standard errors better; {taken}"
    else:
        said = f"{verdict.reason}; {taken}"
    return f"depth camera, {SHUTTER}: {said}"


def _sigma(calibration: Calibration, members: tuple[str, ...]) -> str:
    largest: dict[str, float] = {}
    for name in members:
        largest[kind_of(name)] = max(largest.get(kind_of(name), 0.0), calibration.sigmas[name])
    said = []
    for kind, sigma in largest.items():
        unit, factor = UNITS[kind]
        value = f"{factor * sigma:.2g} {unit}".strip() if np.isfinite(sigma) else "unknown"
        said.append(f"{kind.replace('log_focal', 'focal length')} {value}")
    return ", ".join(said)


def outcome(found: Calibration, camera: Camera) -> str:
    """One line on the colour camera of a depth ``camera``."""
    plain = replace(found, delay=0.0, readout=0.0, vignetting=0.0)
    place = "registered" if plain.is_registered(replace(camera, distortion=())) else "a camera of its own"
    first = {name: members[0] for name, members in TESTED.items()} | {SHUTTER: SHUTTER_PARAMETER}
    names = [name for name, member in first.items() if member in found.estimated]
    if "geometry" in names and "center" in names:
        names.remove("center")
    said = f"{', '.join(names)} estimated" if names else "no correction is proven"
    return f"colour: {place}; {'not tested' if np.isnan(found.sigma).all() else said}"
