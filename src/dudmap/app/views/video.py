"""Videos through OpenCV, whose headless wheel brings FFmpeg with VP9 and MPEG-4, but without H.264."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_path
from dudmap.errors import ConfigError, printable

CODECS = {".mp4": "vp09", ".avi": "XVID"}
"""Codec by the ending: VP9 plays in browsers and takes 0.1 s a frame, MPEG-4 in desktop players and takes 3 ms."""


class VideoWriter:
    """Writes a video, frame by frame; to be used with ``with``.

    Args:
        path: File whose ending names the format.
        size: Width and height, pixels.
        fps: Frames per second.

    Raises:
        ConfigError: The ending is unknown, or this OpenCV cannot write the format.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        import cv2

        codec = CODECS.get(path.suffix.lower())
        if codec is None:
            known = ", ".join(CODECS)
            raise ConfigError(f"cannot write {path.name!r}; the ending must be one of {known}, or .png for a picture")
        if str(path) != printable(path):  # OpenCV ends the process at a name that is no UTF-8
            raise ConfigError(f"cannot write a video as {path}; expected a name of printable characters")
        self._place = ExitStack()
        temporary = self._place.enter_context(atomic_path(path))
        self._writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*codec), fps, size)
        if not self._writer.isOpened():
            temporary.unlink(missing_ok=True)
            raise ConfigError(f"this build of OpenCV cannot write {path} (codec {codec}); name a folder for images")

    def write(self, color: NDArray[np.uint8]) -> None:
        """Add an image (H, W, 3) in RGB order."""
        self._writer.write(np.ascontiguousarray(color[..., ::-1]))

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.release()
        self._place.__exit__(kind, error, trace)
