"""Recordings, suites and systems of a benchmark (suites.toml). Unknown names raise a ``ConfigError``, folders without
recordings a ``DatasetError``."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError
from dudmap.evaluation.files import true_surface
from dudmap.io.exporting.run_content import Box
from dudmap.io.sequences.archive import is_archive, stem
from dudmap.lab.data import find, tables

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dudmap.core.frames.frame import Frame
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.io.sequences import Sequence


@dataclass(frozen=True)
class Entry:
    """One recording of a suite.

    Attributes:
        parameters: Of ``lab.synthetic.sequence``; ``camera``: (width, height) pixels; ``faults``: differing fields of
            ``SensorFaults``.
        parts: Boxes (x0, y0, z0, x1, y1, z1) by name, metres, ground truth frame, for completeness.
    """

    name: str
    path: Path | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict, hash=False)
    address: str = ""
    max_frames: int | None = None
    parts: Mapping[str, Box] = field(default_factory=dict, hash=False)

    def open(self) -> "Sequence":
        """Open the recording, or set up the synthetic one."""
        if self.path is not None:
            from dudmap.io.sequences import open_sequence

            return open_sequence(self.path)
        from dudmap.lab.synthetic import sequence

        return sequence(**self.parameters)

    def surfaces(self, sequence: "Sequence") -> "tuple[Mesh, Mesh] | None":
        """True static surface and observed part, ground truth frame, if known."""
        from dudmap.lab.synthetic.recording import SyntheticSequence

        if isinstance(sequence, SyntheticSequence):
            return sequence.surface(), sequence.surface(observed=True)
        found = None if self.path is None else true_surface(self.path)
        return found and (found.whole, found.whole if found.observed is None else found.observed)


def local_entries(data: Path) -> list[Entry]:
    """Recordings in a folder, or itself."""
    from dudmap.io.sequences import is_recording

    if not data.is_dir():
        raise DatasetError(f"there is no folder {data}; expected one that holds recordings")
    folders = [data, *sorted(child for child in data.iterdir() if child.is_dir())]
    found = [Entry(folder.resolve().name, folder) for folder in folders if is_recording(folder)]
    if not found:
        raise DatasetError(f"no recording found in {data}; `dudmap info` describes a folder")
    return found


class Excerpt:
    """The first ``frames`` frames of a recording (None: all), read once."""

    def __init__(self, recording: "Sequence", frames: int | None = None) -> None:
        self.recording, self.timestamps = recording, recording.timestamps[:frames]
        self.name, self.camera = recording.name, recording.camera
        self.calibration, self.ground_truth = recording.calibration, recording.ground_truth
        self._frames: dict[int, Frame] = {}
        self._masks: dict[int, NDArray[np.bool_] | None] = {}

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - any attribute of the recording
        return getattr(self.recording, name)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> "Frame":
        if index not in self._frames:
            self._frames[index] = self.recording[index]
        return self._frames[index]

    def mask(self, index: int) -> "NDArray[np.bool_] | None":
        """True dynamic mask (H, W) of a frame if known."""
        if index not in self._masks:
            self._masks[index] = self.recording.mask(index)
        return self._masks[index]


DATA = tables("benchmark/suites.toml")
SUITES: dict[str, str] = DATA["suites"]
WORLDS: dict[str, dict[str, dict[str, Any]]] = DATA["worlds"]
PARTS: dict[str, dict[str, Box]] = DATA["parts"]
SYSTEMS: dict[str, tuple[str, ...]] = DATA["systems"]
PASSES = {"two-passes": 2}
UNCALIBRATED = ("colour-as-given",)
"""Systems that do not calibrate the colour camera."""
USUAL = {
    "ablation": ",".join(["dudmap", "two-passes", *(name for name in SYSTEMS if name.startswith("no"))]),
    "sensors": "colour-as-given,no-colour,dudmap",
    "limits": "dudmap,none",
    "fence": "voxel-5mm,voxel-1cm,voxel-2cm,voxel-2cm-16m",
}
"""Systems of a suite, if not the default alone."""
QUICK = ("room-static", "room-person", "room-people-at-start", "two-people", "speed-1.0-50", "camera_path-still-30")


@dataclass(frozen=True)
class Suite:
    """Found and missing recordings of a suite."""

    name: str
    entries: list[Entry]
    missing: list[Entry]

    def names(self) -> list[str]:
        """Names of all recordings, found or not."""
        return [entry.name for entry in [*self.entries, *self.missing]]


def find_suite(name: str, data: Path | None, *, quick: bool = False) -> Suite:
    """Find the recordings of one of ``SUITES``.

    Args:
        data: Searched folder, two levels deep, or a recording.
        quick: A few worlds at 320x240, and 60 frames of recordings.
    """
    find(name, SUITES, "suite")
    missing: list[Entry] = []
    if name in (*WORLDS, "limits"):
        from dudmap.lab.benchmark import limits

        worlds, reduced = (
            WORLDS[name] if name in WORLDS else limits.worlds(),
            {"frames": 60, "camera": (320, 240)} if quick else {},
        )
        names = [key for key in QUICK if key in worlds] if quick else []
        found = [Entry(key, parameters=worlds[key] | reduced, parts=PARTS.get(name, {})) for key in names or worlds]
    elif data is None:
        raise ConfigError(f"the suite {name} reads recordings from disk; name their folder with --data")
    elif name == "local":
        found = local_entries(data)
    elif not (data.is_dir() or is_archive(data)):
        raise DatasetError(f"there is no folder {data}; expected one that holds recordings, or a recording")
    else:
        entries = [
            Entry(key, address=DATA["address"][page]) for page, keys in DATA["recordings"][name].items() for key in keys
        ]
        found, missing = _located(entries, data)
    return Suite(name, [replace(entry, max_frames=60) for entry in found] if quick else found, missing)


def _located(entries: list[Entry], data: Path) -> tuple[list[Entry], list[Entry]]:
    places = [*(path for pattern in ("*/*", "*") for path in sorted(data.glob(pattern))), data.absolute()]
    found = {stem(path): path for path in places if is_archive(path)} | {p.name: p for p in places if p.is_dir()}
    for name in list(found):
        found.setdefault(name.removesuffix("_pre_registereddata"), found[name])
    located = [replace(entry, path=found[entry.name]) for entry in entries if entry.name in found]
    return located, [entry for entry in entries if entry.name not in found]


def systems(names: str) -> dict[str, Config]:
    """Configurations by name: comma-separated ``SYSTEMS`` and TOML files."""
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
