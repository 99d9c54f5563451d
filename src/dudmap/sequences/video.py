"""Frames of an MP4 video, which some applications write instead of images."""

from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError, FrameError
from dudmap.geometry.camera import LARGEST_PIXELS
from dudmap.input_files import open_plain

MARK = b"ftyp"
"""Bytes 4 to 8 of an MP4 file. Without this check the decoder guesses the format, and playlists name other files."""


class Video:
    """Frames of an MP4 file by number.

    Frames are decoded one after the other, as a seek does not reach the exact frame in every video: a frame further
    ahead costs the decoding of those before it, an earlier frame that of all from the beginning.

    Args:
        path: The file.

    Raises:
        DatasetError: The file is no MP4 video that can be decoded, or its frames are too large.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_plain(path) as file:
            head = file.read(8)
        if head[4:] != MARK:
            raise DatasetError(f"{path} is not an MP4 video; expected one as the recording application writes it")
        self._lock = Lock()
        self._open()

    def _open(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the depth images are not turned either
        width, height = (self._capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not self._capture.isOpened() or not 0 < width * height <= LARGEST_PIXELS:
            raise DatasetError(
                f"{self.path} cannot be decoded: it is damaged, not copied to its end (where its index stands), or has "
                f"frames of more than {LARGEST_PIXELS / 1e6:.0f} million pixels"
            )
        self._next = 0

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Frame (H, W, 3), RGB.

        Raises:
            FrameError: The video has fewer frames, or is damaged there.
        """
        import cv2

        with self._lock:
            if index < self._next - 1:
                self._open()
            while self._next <= index:
                if not self._capture.grab():
                    raise FrameError(f"{self.path} has no frame {index}; it ends after {self._next} frames")
                self._next += 1
            found, image = self._capture.retrieve()
        if not found:
            raise FrameError(f"frame {index} of {self.path} cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
