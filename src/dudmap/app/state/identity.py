"""What a stored state fits: the code that wrote it and the recording that it is of."""

import hashlib
from dataclasses import astuple
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dudmap.app.pipeline.environment import versions
from dudmap.errors import FrameError

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
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
