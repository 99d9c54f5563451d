"""Named configurations that the benchmarks compare."""

from pathlib import Path

from dudmap.config import Config
from dudmap.errors import ConfigError

SYSTEMS: dict[str, tuple[str, ...]] = {
    "dudmap": (),
    "two-passes": (),
    "thesis": ("preset=thesis",),
    "threshold": (
        "dynamics.method=threshold",
        "volume.truncation_voxels=10",
        "volume.truncation_behind_voxels=10",
    ),
    "none": ("dynamics.method=none",),
    "em": ("dynamics.free_space=false", "dynamics.regions=false", "dynamics.start_seconds=0"),
    "no-start": ("dynamics.start_seconds=0",),
    "no-free-space": ("dynamics.free_space=false",),
    "no-regions": ("dynamics.regions=false",),
    "no-pieces": ("dynamics.pieces=false",),
    "no-second-registration": ("tracker.second_pass=false",),
    "no-carving": ("volume.carving=false",),
    "no-limit-of-readings": ("volume.max_readings=255",),
    "no-colour": ("tracker.color_weight=0",),
    "no-exposure-fit": ("tracker.exposure=false",),
    "no-noise-weighting": ("tracker.noise_weighting=false",),
    "no-relocalisation": ("relocalization.enabled=false",),
}
"""Differences from the default configuration: the default itself; the default with two passes; the values of the
thesis; threshold and flood fill as in ReFusion, with its threshold of 7 cm and the truncation distance of 10 cm that it
needs; no detection of dynamics; EM on the residuals alone; and the default with one part switched off."""
ABLATION = ",".join(["dudmap", "two-passes", *(name for name in SYSTEMS if name.startswith("no"))])
"""Systems of the suite ``ablation``."""

PASSES = {"two-passes": 2}
"""Systems that process a recording more than once, and how often."""


def system(name: str) -> tuple[str, Config]:
    """Name and configuration of a system: one of ``SYSTEMS``, or the path of a TOML file, whose stem is the name.

    Raises:
        ConfigError: The name is neither, or the file is not a valid configuration.
    """
    if name in SYSTEMS:
        return name, Config().override(SYSTEMS[name])
    if name.endswith(".toml"):
        return Path(name).stem, Config.load(name)
    raise ConfigError(f"unknown system {name!r}; known are {', '.join(SYSTEMS)} and the path of a .toml file")


def systems(names: str) -> dict[str, Config]:
    """Configurations by name, of a comma-separated list.

    Raises:
        ConfigError: The list is empty, a name is unknown, or two systems have the same name.
    """
    found = [system(name.strip()) for name in names.split(",") if name.strip()]
    if not found:
        raise ConfigError(f"no system is named; known are {', '.join(SYSTEMS)} and the path of a .toml file")
    if len(dict(found)) < len(found):
        raise ConfigError(f"two systems have the same name in {names!r}; give the .toml files different names")
    return dict(found)
