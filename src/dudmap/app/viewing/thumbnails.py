"""Small images of evenly spaced frames, kept in the run folder for the report."""

from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run_folder import WRITTEN
from dudmap.app.viewing.run_files import FOLDER
from dudmap.app.viewing.snapshot import FrameImages
from dudmap.atomic_file import write_bytes
from dudmap.errors import FrameError
from dudmap.own_folder import OwnFolder, make_folder, remove_files

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

NUMBER = 36
"""Number of frames that are kept: about 1.5 MB of JPEG files, and a strip that can still be looked through."""


class Thumbnails(RunObserver):
    """Writes ``thumbnails/<timestamp>.<kind>.jpg`` for up to ``NUMBER`` evenly spaced frames.

    Of a camera, whose number of frames is not known, up to ``2 NUMBER`` are kept: whenever there are more, every second
    one is removed.
    """

    def __init__(self) -> None:
        self._out, self._count, self._next, self._step = Path(), None, 0, 1
        self._kept: list[list[Path]] = []

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Remember where the images go and how many frames come."""
        self._out, self._count, self._next, self._step, self._kept = out / FOLDER, count, 0, 1, []
        make_folder(self._out)
        remove_files(out, {FOLDER: WRITTEN[FOLDER]})  # of the first pass, whose timestamps may differ in a live run

    def resume(self, slam: "Slam", out: Path, count: int | None, first: int) -> None:
        """Keep the images of the frames before number ``first``."""
        self._out, self._count, self._step, self._kept = out / FOLDER, count, 1, []
        make_folder(self._out)
        self._next = self._next_after(first - 1)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Write the images of the frame if it is the first one of the next of equal parts."""
        if index < self._next or isinstance(read.frame, FrameError):
            return
        paths = []
        for kind, file in FrameImages.of(read.frame, result).files().items():
            paths.append(self._out / f"{result.timestamp:.6f}.{kind}.jpg")
            write_bytes(paths[-1], file, sync=False, own=True)
        self._kept.append(paths)
        if self._count is None:
            self._thin()
            self._next = index + self._step
        else:
            self._next = self._next_after(index)

    def _next_after(self, index: int) -> int:
        """First frame of the next of NUMBER equal parts."""
        assert self._count is not None
        return -(-(index * NUMBER // self._count + 1) * self._count // NUMBER)

    def _thin(self) -> None:
        """Remove every second frame if there are too many, and keep half as many from now on."""
        if len(self._kept) <= 2 * NUMBER:
            return
        with OwnFolder(self._out) as folder:
            for path in (path for paths in self._kept[1::2] for path in paths):
                folder.remove(path.name)
        self._kept, self._step = self._kept[::2], 2 * self._step
