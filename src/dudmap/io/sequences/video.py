"""Frames of videos by number."""

from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import LARGEST_PIXELS
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import open_plain

MARK = b"ftyp"
"""Bytes 4 to 8 of an MP4 file: the decoder guesses, and playlists name other files."""


EXACT = 1e-5
"""Largest error of a frame number from a time."""
FAR = 60
"""Frames ahead up to which decoding is cheaper than a search."""


class Video:
    """Frames of an MP4 file by number.

    Increasing frames are decoded one after the other; others are found by seeking at a constant rate, else decoded from
    the beginning.

    Raises:
        DatasetError: No decodable MP4 video, or too large frames.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_plain(path) as file:
            head = file.read(8)
        if head[4:] != MARK:
            raise DatasetError(f"{path} is not an MP4 video; expected one as the recording application writes it")
        self._lock = Lock()
        self._constant: bool | None = None  # the rate of the frames, once it is needed
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

    def _jump(self, index: int) -> None:
        import cv2

        self._open()
        if index > FAR and self._constant is None:
            last = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) - 1
            step = self._next_is(0) and self._next_is(1)
            self._constant = step and self._finds(last) and not self._capture.grab()
        if index > FAR and self._constant and self._finds(index):
            self._next = index + 1
        elif index > FAR:
            self._open()

    def _finds(self, index: int) -> bool:
        import cv2

        self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
        return self._next_is(index)

    def _next_is(self, index: int) -> bool:
        import cv2

        rate = self._capture.get(cv2.CAP_PROP_FPS) / 1000
        return self._capture.grab() and abs(self._capture.get(cv2.CAP_PROP_POS_MSEC) * rate - index) < EXACT

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Frame (H, W, 3), RGB.

        Raises:
            FrameError: The video is shorter, or damaged there.
        """
        import cv2

        with self._lock:
            if not self._next - 1 <= index <= self._next + FAR:
                self._jump(index)
            while self._next <= index:
                if not self._capture.grab():
                    raise FrameError(f"{self.path} has no frame {index}; it ends after {self._next} frames")
                self._next += 1
            found, image = self._capture.retrieve()
        if not found:
            raise FrameError(f"frame {index} of {self.path} cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
