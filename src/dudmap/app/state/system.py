"""A system and what belongs to it, from and into a database, and what a stored state fits."""

import hashlib
from dataclasses import asdict, astuple
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.app.pipeline.environment import versions
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.tree import Snapshot, TreeReader, TreeWriter
from dudmap.config import Config
from dudmap.core.geometry.camera import Camera
from dudmap.errors import FrameError, StateError
from dudmap.input_files import damaged

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence

CODE = ("config.py", "core", "app/state", "app/pipeline/metrics.py", "app/pipeline/storing.py")
"""Parts of this package that a state depends on."""


@cache
def code_fingerprint() -> str:
    """Checksum of the code that computes a state and of the versions of the libraries it uses.

    A state is continued by the code that wrote it and by no other: with any other the result would be that of neither.
    """
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    root = Path(str(files("dudmap")))
    for part in CODE:
        place = root / part
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def recording_fingerprint(sequence: "Sequence") -> str:
    """Checksum of the times, the camera and the first readable frame of a recording."""
    digest = hashlib.sha256(np.ascontiguousarray(sequence.timestamps, np.float64).tobytes())
    digest.update(repr((astuple(sequence.camera), len(sequence))).encode())
    digest.update(frame_fingerprint(sequence, 0).encode())
    return digest.hexdigest()


def frame_fingerprint(sequence: "Sequence", index: int) -> str:
    """Checksum of a frame of a recording; see ``images_fingerprint``."""
    try:
        return images_fingerprint(sequence[index])
    except FrameError as error:
        return images_fingerprint(error)


def images_fingerprint(frame: "Frame | Exception") -> str:
    """Checksum of the images of a frame, or of the sentence on why it cannot be read."""
    if isinstance(frame, Exception):
        return hashlib.sha256(str(frame).encode()).hexdigest()
    digest = hashlib.sha256(repr((frame.timestamp, frame.color_timestamp)).encode())
    for image in (frame.depth, frame.color):
        digest.update(np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()


def take_snapshot(value: object, database: StateDatabase, *, wait: bool = True) -> Snapshot:
    """The state of a value, such as a system, without what the database, in which it will be written, holds already.

    Without ``wait`` it raises ``NotSettledError`` while something is computed in the background.

    Raises:
        StateError: There is something that cannot be stored.
    """
    return TreeWriter(database.maps, database.frames, wait=wait).take(value)


def restore(reader: StateReader, current: object, database: StateDatabase | None = None, device: str = "cpu") -> Any:  # noqa: ANN401
    """The value that was stored last, made of the objects of a new one of the same kind (``TreeReader.restore``).

    The reader stays open as long as the system lives: it reads stored frames when it needs them. Where the run goes on
    in the same database, that takes note of what it holds. ``device`` is that of the maps that ``current`` lacks.

    Raises:
        StateError: The database is damaged or of another version, or holds no state yet.
    """
    value = TreeReader(reader, database, device).restore(current)
    reader.release()
    return value


def save_system(slam: "Slam", path: str | Path) -> None:
    """Write the whole state of a system, from which ``resume_system`` goes on, replacing an older file at the end.

    Raises:
        StateError: The file cannot be written.
    """
    import sqlite3

    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    about = {"camera": asdict(slam.first_camera), "config": slam.config.model_dump_json()}
    try:
        part.unlink(missing_ok=True)
        database = StateDatabase(part)
        try:
            database.write(take_snapshot(slam, database), about | {"code": code_fingerprint(), "versions": versions()})
        finally:
            database.close()
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        part.unlink(missing_ok=True)
        raise StateError(f"the state cannot be written to {path}: {error}") from error


def resume_system(path: str | Path, device: str | None = None) -> "Slam":
    """A system in the state that ``save_system`` wrote: the frames that follow give the same results, bit for bit.

    With another ``device`` than that of the run the results differ by roundings. The file stays open and must stay as
    it is while the system lives: stored frames are read from it.

    Raises:
        StateError: The file is missing, damaged, or was written by another version.
    """
    from dudmap.core.slam import Slam

    path = Path(path)
    reader = StateReader(path)
    meta = reader.meta()
    check_code(meta, path)
    with damaged(StateError, path):
        camera = Camera(**meta["camera"] | {"distortion": tuple(meta["camera"]["distortion"])})
        config = on_device(Config.model_validate_json(meta["config"]), device)
    slam = Slam(camera, config)
    return restore(reader, slam, device=slam.device)


def on_device(config: Config, device: str | None) -> Config:
    """The configuration with another device; None keeps that of the run."""
    return config if device is None else config.override([f"device={device}"])


def check_code(meta: dict[str, Any], path: Path) -> None:
    """Refuse a state that was written by another version."""
    if meta.get("code") != code_fingerprint():
        raise StateError(
            f"{path} was written by another version of dudmap or its libraries ({meta.get('versions', 'unknown')}); "
            f"expected {versions()}, or begin anew with dudmap run"
        )
