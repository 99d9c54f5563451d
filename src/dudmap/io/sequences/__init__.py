"""Readers of recordings: one class per format with the interface ``Sequence``."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple, replace
from functools import cache
from importlib import import_module
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError, printable
from dudmap.input_files import damaged
from dudmap.io.sequences import intrinsics
from dudmap.io.sequences.gravity import Gravity

__all__ = ["Recording", "Sequence", "has_color", "is_recording", "is_timed", "open_sequence", "reader_of", "readers"]


@runtime_checkable
class Sequence(Protocol):
    """A recording with random access to its frames.

    Attributes:
        name: Short name, for folders.
        camera: Of the depth images, and of registered colour.
        calibration: Of the colour camera; None for registered colour.
        timestamps: (N,) float64 strictly increasing, of the depth images, seconds.
        ground_truth: True camera poses if known, for evaluation only.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def camera(self) -> Camera: ...  # noqa: D102
    @property
    def calibration(self) -> Calibration | None: ...  # noqa: D102
    @property
    def timestamps(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def ground_truth(self) -> Trajectory | None: ...  # noqa: D102

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index``.

        Raises:
            FrameError: It cannot be read; others may be valid.
        """
        ...

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame if known, for evaluation only."""
        ...


class Recording(ABC):
    """A ``Sequence`` on disk, which reads a frame on access.

    A format sets times, cameras and sources in its constructor, which raises a ``DatasetError`` for damage and a
    ``MissingExtraError`` without its package; ``_frame`` reads a frame.

    Args:
        path: The folder or file.
        camera: Intrinsics that replace the recording's.

    Attributes:
        format: Name for people.
        options: Options of ``open_sequence`` that the format has.
        sources: Origin of ``intrinsics``, ``depth unit`` and ``times``.
        remarks: Sentences on omitted data and assumptions.
        timed: False for assumed times.
        has_color: False without colour in all frames.
        gravity: Measured directions against gravity, or None; reading may raise a ``DatasetError``.
        opened: Arguments of ``open_sequence`` that open it again.
    """

    format = ""
    options: tuple[str, ...] = ()
    truth = ""
    """Conversion of published poses, if any."""
    suffix = ""
    """Suffix of single files."""
    layout: tuple[str, ...] = ()
    """Patterns of files and folders of the format."""
    timed = True
    has_color = True
    camera: Camera
    calibration: Calibration | None = None
    timestamps: NDArray[np.float64]
    ground_truth: Trajectory | None = None
    gravity: Gravity | None = None
    sources: dict[str, str]
    opened: dict[str, Any]
    remarks: Iterable[str] = ()

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().stem

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a path has this format, by names and first bytes."""
        if cls.suffix:
            return path.suffix.lower() == cls.suffix and path.is_file()
        return path.is_dir() and all(any(path.glob(pattern)) for pattern in cls.layout)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index``.

        Raises:
            FrameError: An image is missing, damaged, or of another size.
        """
        index = range(len(self))[index]
        name = f"frame {index} of {self.path}"
        with damaged(FrameError, name):
            return self._frame(index, name)

    def mask(self, index: int) -> NDArray[np.bool_] | None:
        """True dynamic mask (H, W) of a frame, or None."""
        return None

    def set_depth_unit(self, unit: float) -> None:
        """Replace the metres per unit of 16-bit depth."""
        self.camera = replace(self.camera, depth_scale=1.0 / unit)
        self.sources["depth unit"] = f"--depth-unit {unit:g}"

    @abstractmethod
    def _frame(self, index: int, name: str) -> Frame:
        """Read a frame; ``name`` is used in messages."""

    def _set_cameras(self, own: Camera, color: Calibration, source: str, given: Camera | str | None) -> None:
        known = intrinsics.given(given) if given else None
        self.camera = known.camera(own.width, own.height, own.depth_scale) if known else own
        one_size = (color.camera.width, color.camera.height) == (own.width, own.height)
        self.calibration = None if color.is_registered(self.camera) or (known and one_size) else color
        unit = known.source if known and "depth_scale" in known.values else source
        self.sources = {"intrinsics": known.source if known else source, "depth unit": unit, "times": source}


READERS = (
    "tum:BonnSequence",
    "tum:CorbsSequence",
    "tum:OpenLorisSequence",
    "numbered_folders:IclNuimSequence",
    "numbered_folders:IclNuimLoopSequence",
    "tum:TumSequence",
    "phones:NerfstudioSequence",
    "numbered_folders:VolumeDeformSequence",
    "numbered_folders:SharedFrameFiles",
    "numbered_folders:ScanNetSequence",
    "numbered_folders:ReplicaSequence",
    "phones:StrayScannerSequence",
    "phones:ArkitScenesSequence",
    "phones:PolycamSequence",
    "phones:Record3DFolder",
    "numbered_folders:RedwoodSequence",
    "numbered_folders:EpflSequence",
    "numbered:BopSequence",
    "numbered:NumberedSequence",
    "image_logs:SensRecording",
    "image_logs:KlgRecording",
    "image_logs:Record3DRecording",
    "azure_kinect:AzureKinectRecording",
    "bag:RealSenseRecording",
    "bag:RosBag",
)
"""Module and class of every reader, specific layouts first."""
NUMBERED = READERS.index("numbered:NumberedSequence")
MOST_NAMES = 5
DEPTH_OF_SEARCH = 3


@cache
def readers() -> tuple[type[Recording], ...]:
    """Readers of all formats, in order."""
    names = (reader.split(":") for reader in READERS)
    return tuple(getattr(import_module(f"dudmap.io.sequences.{module}"), name) for module, name in names)


def reader_of(path: Path) -> type[Recording] | None:
    """First reader of a path, or None."""
    return next((reader for reader in readers() if reader.recognises(path)), None)


def is_recording(path: Path) -> bool:
    """Whether a path is a known recording or an archive."""
    from dudmap.io.sequences.archive import is_archive

    return path.exists() and (reader_of(path) is not None or is_archive(path))


def is_timed(sequence: object) -> bool:
    """Whether the times of a sequence are known."""
    return getattr(sequence, "timed", True)


def has_color(sequence: object) -> bool:
    """Whether a sequence has colour images."""
    return getattr(sequence, "has_color", True)


def read_frame(sequence: "Sequence", index: int) -> Frame:
    """Read a frame into its own memory, because a user's class may reuse its images.

    Raises:
        FrameError: It cannot be read; others may be valid.
    """
    frame = sequence[index]
    return frame if isinstance(sequence, Recording) else frame.copy()


def open_sequence(
    path: str | Path,
    camera: Camera | str | None = None,
    fps: float | None = None,
    depth_unit: float | None = None,
    **options: Any,  # noqa: ANN401
) -> Recording:
    """Open a recording with the first of ``readers()`` that recognises it, also inside a folder.

    An archive (.zip, .tar, .tgz, .tar.gz, .tar.bz2, .tar.xz) is unpacked into a cache first; ``archive.zip/folder``
    names one of several recordings in it.

    Args:
        path: Folder, file or archive.
        camera: Replaces the recording's: a Camera, or ``fx,fy,cx,cy[,w,h[,depth_scale]]``, by default with the images'
            size and the format's depth scale.
        fps: Of a recording without times; default 30.
        depth_unit: Metres per 16-bit unit, such as 0.001; replaces other units.
        options: Of one format, e.g. ``topics`` of bags; None: not given.

    Raises:
        DatasetError: No path, no known format, several recordings, damage, or an unknown option.
    """
    path = Path(path)
    with damaged(DatasetError, f"the recording {path}"):
        patterned = path.is_dir() and (options.get("color") or options.get("depth"))
        place, reader = (path, readers()[NUMBERED]) if patterned else _find(path)
    given = {name: value for name, value in options.items() if value is not None}
    numbers = {"fps": fps, "depth_unit": depth_unit}
    for name, number in numbers.items():
        if number is not None and not (isfinite(number) and number > 0):
            raise DatasetError(f"found {_option(name)} {number:g}; expected a positive number")
    named = [*given, *(name for name, number in numbers.items() if number is not None)]
    foreign = [_option(name) for name in named if name not in reader.options]
    if foreign:
        raise DatasetError(
            f"{path} is a recording in the format {reader.format}, which has no {' and no '.join(foreign)}"
        )
    with damaged(DatasetError, f"the recording {place}"):
        make: Any = reader
        recording = make(place, camera, **given)
        if depth_unit is not None:
            recording.set_depth_unit(depth_unit)
        if fps is not None:
            recording.set_rate(fps)
        recording.name = printable(recording.name)
        again = camera if isinstance(camera, str | None) else ",".join(map(str, astuple(camera)[:7]))
        recording.opened = {"path": str(path.resolve()), "camera": again, **numbers, **given}
        return recording


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _find(path: Path) -> tuple[Path, type[Recording]]:
    from dudmap.io.sequences.archive import split, unpack

    reader = reader_of(path) if path.exists() else None
    if reader is not None:
        return path, reader
    packed = split(path)
    if packed is not None:
        return _find(unpack(packed[0]) / packed[1])
    if not path.exists():
        raise DatasetError(f"there is no folder or file {path}; expected a recording")
    if path.is_dir() and not any(path.iterdir()):
        raise DatasetError(f"the folder {path} is empty; expected a recording")
    if all((path / name).is_file() for name in ("metrics.json", "trajectory.txt")):
        raise DatasetError(f"{path} is the result of a run; expected a recording (dudmap view shows results)")
    found = _recordings_in(path, DEPTH_OF_SEARCH) if path.is_dir() else []
    if not found and path.is_dir():
        found = [(place, readers()[NUMBERED]) for place in _places_by_content(path)]
    if len(found) > 1:
        names = ", ".join(str(place.relative_to(path)) for place, _ in found[:MOST_NAMES])
        more = f" and {len(found) - MOST_NAMES} more" if len(found) > MOST_NAMES else ""
        raise DatasetError(f"{path} contains {len(found)} recordings; name one of {names}{more}")
    if not found:
        raise DatasetError(_unknown(path))
    place, reader = found[0]
    return (place, reader) if reader is not None else _find(place)


def _recordings_in(path: Path, levels: int) -> "list[tuple[Path, type[Recording] | None]]":
    """Recordings below a folder, and archives with None; none inside of others."""
    from dudmap.io.sequences.archive import is_archive

    found: list[tuple[Path, type[Recording] | None]] = []
    for place in sorted(path.iterdir()):
        reader = reader_of(place)
        if reader is not None:
            found.append((place, reader))
        elif is_archive(place):
            found.append((place, None))
        elif place.is_dir() and levels > 1:
            found += _recordings_in(place, levels - 1)
    return found


def _places_by_content(path: Path) -> list[Path]:
    """Folders of depth and colour images by content, else depth alone."""
    from dudmap.io.sequences.image_series import alone, by_content, unknown

    def search(place: Path, kinds: Callable[[Path], dict], levels: int) -> list[Path]:
        if kinds(place):
            return [place]
        if levels == 0 or (kinds is alone and unknown(place)):  # other images may be colour
            return []
        folders = (below for below in sorted(place.iterdir()) if below.is_dir())
        return [found for below in folders for found in search(below, kinds, levels - 1)]

    return search(path, by_content, DEPTH_OF_SEARCH) or search(path, alone, DEPTH_OF_SEARCH)


def _unknown(path: Path) -> str:
    from dudmap.io.sequences.image_series import unknown as images_in

    listed = [name for name in ("rgb.txt", "depth.txt") if (path / name).is_file()]
    if listed:
        other = "depth.txt" if listed == ["rgb.txt"] else "rgb.txt"
        return f"{path} is not a recording in TUM layout: {other} not found (an associations.txt would do instead)"
    if path.is_dir() and (images := images_in(path)):
        return images
    formats = ", ".join(dict.fromkeys(reader.format for reader in readers()))
    kind = "folder" if path.is_dir() else "file"
    return f"{path} is a {kind} in no known format; dudmap reads {formats} (described in docs/formats.md)"
