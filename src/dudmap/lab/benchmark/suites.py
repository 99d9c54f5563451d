"""Benchmark suites and systems: their recordings, where these can be downloaded from, and the configurations compared.

``suites.toml`` lists them.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError
from dudmap.io.sequences.archive import is_archive, stem
from dudmap.lab.benchmark.entries import Entry, local_entries
from dudmap.lab.data import tables

DATA = tables("benchmark/suites.toml")
SUITES: dict[str, str] = DATA["suites"]
"""What each suite is, by name."""
WORLDS: dict[str, dict[str, dict[str, Any]]] = DATA["worlds"]
"""Parameters of the synthetic worlds of a suite, by name."""
SENSORS: dict[str, dict[str, Any]] = DATA["sensors"]
"""The same static room, taken with sensors of different faults and with named cameras."""
SYSTEMS: dict[str, tuple[str, ...]] = DATA["systems"]
"""Differences from the default configuration, by name."""
PASSES = {"two-passes": 2}
"""Systems that process a recording more than once, and how often."""
ABLATION = ",".join(["dudmap", "two-passes", *(name for name in SYSTEMS if name.startswith("no"))])
"""Systems of the suite ``ablation``."""
ROOM = {"movers": (), "frames": 120}
QUICK = ("room-static", "room-person", "room-people-at-start", "two-people")


@dataclass(frozen=True)
class Suite:
    """Recordings of a suite that were found, and those that are missing."""

    name: str
    entries: list[Entry]
    missing: list[Entry]

    def names(self) -> list[str]:
        """Names of all recordings of the suite, found or not."""
        return [entry.name for entry in [*self.entries, *self.missing]]


def find_suite(name: str, data: Path | None, *, quick: bool = False) -> Suite:
    """Find the recordings of one of ``SUITES``.

    Args:
        data: Folder that is searched, two levels deep; synthetic worlds need none.
        quick: Only one to three synthetic worlds, and at most 60 frames of every recording.

    Raises:
        ConfigError: There is no such suite, or it needs ``data``.
        DatasetError: ``data`` is no folder, or for the suite ``local`` holds no recording.
    """
    if name not in SUITES:
        raise ConfigError(f"unknown suite {name!r}; known suites: {', '.join(SUITES)}")
    missing: list[Entry] = []
    if name in WORLDS:
        worlds = {key: world for key, world in WORLDS[name].items() if not quick or key in QUICK}
        found = [Entry(key, parameters=world | ({"frames": 60} if quick else {})) for key, world in worlds.items()]
    elif data is None:
        raise ConfigError(f"the suite {name} reads recordings from disk; name their folder with --data")
    elif name == "local":
        found = local_entries(data)
    elif not data.is_dir():
        raise DatasetError(f"there is no folder {data}; expected one that holds recordings")
    else:
        entries = [
            Entry(key, address=DATA["address"][page]) for page, keys in DATA["recordings"][name].items() for key in keys
        ]
        found, missing = _located(entries, data)
    return Suite(name, [replace(entry, max_frames=60) for entry in found] if quick else found, missing)


def sensor_entries(names: list[str] | None = None, *, quick: bool = False) -> list[Entry]:
    """The room of suite ``sensors``, taken with every sensor or with the named ones, ``quick`` in small images.

    Raises:
        ConfigError: A name is unknown.
    """
    unknown = [name for name in names or [] if name not in SENSORS]
    if unknown:
        raise ConfigError(f"unknown sensor of the suite {unknown[0]!r}; known are {', '.join(SENSORS)}")
    size = {"camera": (320, 240) if quick else (640, 480)}
    return [Entry(name, parameters=ROOM | size | SENSORS[name]) for name in names or SENSORS]


def _located(entries: list[Entry], data: Path) -> tuple[list[Entry], list[Entry]]:
    """Entries whose folder or archive is found in ``data`` or one level below, and the others.

    The images of a CoRBS scene are in ``<name>_pre_registereddata``, as downloaded.
    """
    places = [path for pattern in ("*/*", "*") for path in sorted(data.glob(pattern))]
    found = {stem(path): path for path in places if is_archive(path)} | {p.name: p for p in places if p.is_dir()}
    for name in list(found):
        found.setdefault(name.removesuffix("_pre_registereddata"), found[name])
    located = [replace(entry, path=found[entry.name]) for entry in entries if entry.name in found]
    return located, [entry for entry in entries if entry.name not in found]


def systems(names: str) -> dict[str, Config]:
    """Configurations by name, of a comma-separated list of ``SYSTEMS`` and of paths of TOML files.

    Raises:
        ConfigError: The list is empty, a name is unknown, a file is not a valid configuration, or two systems have the
            same name.
    """
    found: dict[str, Config] = {}
    for name in (name.strip() for name in names.split(",") if name.strip()):
        if name not in SYSTEMS and not name.endswith(".toml"):
            known = f"{', '.join(SYSTEMS)} and the path of a .toml file"
            raise ConfigError(f"unknown system {name!r}; known are {known}")
        short = name if name in SYSTEMS else Path(name).stem
        if short in found:
            raise ConfigError(f"two systems have the same name in {names!r}; give the .toml files different names")
        found[short] = Config().override(SYSTEMS[name]) if name in SYSTEMS else Config.load(name)
    if not found:
        raise ConfigError(f"no system is named; known are {', '.join(SYSTEMS)} and the path of a .toml file")
    return found
