"""Store and restore a system, and check that a state fits code and recording."""

import hashlib
from collections.abc import Mapping
from dataclasses import astuple, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.app.pipeline.environment import versions
from dudmap.app.state.blocks import Snapshot
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.tree import TreeReader, TreeWriter
from dudmap.config import Config
from dudmap.errors import FrameError, StateError

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence

CODE = ("config.py", "core", "app/state", "app/pipeline/metrics.py", "app/pipeline/storing.py")
"""Parts of this package that a state depends on."""


@cache
def code_fingerprint() -> str:
    """Checksum of the code and library versions behind a state."""
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    root = Path(str(files("dudmap")))
    for part in CODE:
        place = root / part
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def recording_fingerprint(sequence: "Sequence") -> str:
    """Checksum of times, camera and first readable frame."""
    digest = hashlib.sha256(np.ascontiguousarray(sequence.timestamps, np.float64).tobytes())
    digest.update(repr((astuple(sequence.camera), len(sequence))).encode())
    digest.update(frame_fingerprint(sequence, 0).encode())
    return digest.hexdigest()


def frame_fingerprint(sequence: "Sequence", index: int) -> str:
    """Checksum of a frame; see ``images_fingerprint``."""
    try:
        return images_fingerprint(sequence[index])
    except FrameError as error:
        return images_fingerprint(error)


def images_fingerprint(frame: "Frame | Exception") -> str:
    """Checksum of the images of a frame, or of its error text."""
    if isinstance(frame, Exception):
        return hashlib.sha256(str(frame).encode()).hexdigest()
    digest = hashlib.sha256(repr((frame.timestamp, frame.color_timestamp)).encode())
    for image in (frame.depth, frame.rgb):
        digest.update(np.ascontiguousarray(image).tobytes())
    return digest.hexdigest()


def take_snapshot(parts: Mapping[str, object], database: StateDatabase, *, wait: bool = True) -> Snapshot:
    """Take the state of named parts, without content in the database.

    Without ``wait`` it raises ``NotSettledError`` during background computations.

    Raises:
        StateError: A part cannot be stored.
    """
    return TreeWriter(database.maps, database.frames, wait=wait).take(parts)


def parts_of(slam: "Slam") -> dict[str, object]:
    """Parts of a system's state, including its first pass."""
    first = slam.first_pass
    before = {} if first is None else {"first arguments": first.arguments, "first slam": first}
    return before | {"arguments": slam.arguments, "slam": slam}


def read_system(tree: TreeReader, device: str | None, which: str = "") -> "Slam":
    """Restore a system from these parts, on ``device`` if given."""
    from dudmap.core.slam import Slam, SlamArguments

    first = read_system(tree, device, "first ") if not which and "first slam" in tree else None
    arguments = tree.part(f"{which}arguments", SlamArguments)
    given = vars(replace(arguments, config=on_device(arguments.config, device)))
    slam = Slam(first_pass=first, **given)
    tree.device = slam.device
    return tree.part(f"{which}slam", Slam, slam)


def save_system(slam: "Slam", path: str | Path) -> None:
    """Write a system's state for ``resume_system``; replaces an older file at the end.

    Raises:
        StateError: The file cannot be written.
    """
    import sqlite3

    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        part.unlink(missing_ok=True)
        database = StateDatabase(part)
        try:
            about = {"code": code_fingerprint(), "versions": versions()}
            database.write(take_snapshot(parts_of(slam), database), about)
        finally:
            database.close()
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        part.unlink(missing_ok=True)
        raise StateError(f"the state cannot be written to {path}: {error}") from error


def resume_system(path: str | Path, device: str | None = None) -> "Slam":
    """Restore a system of ``save_system``, with bit-identical results; on another ``device`` they differ by rounding.

    The file must stay, because stored frames are read from it.

    Raises:
        StateError: The file is missing, damaged, or of another version.
    """
    path = Path(path)
    reader = StateReader(path)
    check_code(reader.meta(), path)
    with TreeReader(reader) as tree:
        return read_system(tree, device)


def on_device(config: Config, device: str | None) -> Config:
    """Configuration with another device; None keeps it."""
    return config if device is None else config.override([f"device={device}"])


def check_code(meta: dict[str, Any], path: Path) -> None:
    """Refuse a state of another version."""
    if meta.get("code") != code_fingerprint():
        stored, here = meta.get("versions", {}), versions()
        other = ", ".join(
            f"{name} {stored.get(name)}, here {here[name]}" for name in here if stored.get(name) != here[name]
        )
        raise StateError(
            f"{path} was written by another version of dudmap or its libraries ({other or 'its code has changed'}); "
            "bring it back, or begin again with dudmap run"
        )
