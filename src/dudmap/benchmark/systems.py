"""Systems that a benchmark compares: configurations with a name."""

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
}
"""What each differs in from the default configuration: the default itself, the default over the recording twice, the
thesis' values, the threshold-and-flood rule of the thesis' ancestor with its threshold of 7 cm and the band of 10 cm
that this needs, no dynamic handling at all, and EM on the residuals alone."""

PASSES = {"two-passes": 2}
"""Systems that go over a recording more than once."""


def system(name: str) -> tuple[str, Config]:
    """Name and configuration of a system: one of ``SYSTEMS``, or the path of a TOML file named by its stem.

    Raises:
        ConfigError: It is neither, or the file is not an acceptable configuration.
    """
    if name in SYSTEMS:
        return name, Config().override(SYSTEMS[name])
    if name.endswith(".toml"):
        return Path(name).stem, Config.load(name)
    raise ConfigError(f"unknown system {name!r}; known are {', '.join(SYSTEMS)} and the path of a .toml file")


def systems(names: str) -> dict[str, Config]:
    """Systems of a comma-separated list.

    Raises:
        ConfigError: The list is empty, a name is unknown, or two systems have the same name.
    """
    found = [system(name.strip()) for name in names.split(",") if name.strip()]
    if not found:
        raise ConfigError(f"no system is named; known are {', '.join(SYSTEMS)} and the path of a .toml file")
    if len(dict(found)) < len(found):
        raise ConfigError(f"two systems have the same name in {names!r}; give the .toml files different names")
    return dict(found)
