"""Temporary file for stored frames, in which the room of removed frames is used again."""

import tempfile
import weakref
from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO

from dudmap.errors import MapError


@dataclass(frozen=True)
class FilePlace:
    """Where a frame is in the file: the first byte, and the bytes of each part, which follow each other."""

    start: int
    sizes: tuple[int, ...]

    @property
    def end(self) -> int:
        """The byte after the last one."""
        return self.start + sum(self.sizes)


class FrameFile:
    """A temporary file, made at the first frame, which the operating system removes."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._end = 0
        self._free: list[tuple[int, int]] = []  # first byte and the one after the last, ascending, none beside another

    @property
    def num_bytes(self) -> int:
        """Size of the file."""
        return self._end

    def write(self, parts: Sequence[bytes]) -> FilePlace:
        """Write a frame into the first gap that holds it, or at the end.

        Raises:
            MapError: The file cannot be written.
        """
        sizes = tuple(len(part) for part in parts)
        gap = next((n for n, (start, end) in enumerate(self._free) if end - start >= sum(sizes)), None)
        place = FilePlace(self._end if gap is None else self._free[gap][0], sizes)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="dudmap-")
                weakref.finalize(self, self._file.close)
            self._file.seek(place.start)
            for part in parts:
                self._file.write(part)
        except OSError as error:
            raise MapError(
                f"fused frames cannot be stored in {tempfile.gettempdir()}: {error}; make room there, name another "
                "folder in the environment variable TMPDIR, or switch off loops.enabled and submaps.enabled"
            ) from error
        if gap is None:
            self._end = place.end
        else:
            rest = place.end, self._free[gap][1]
            self._free[gap : gap + 1] = [rest] if rest[0] < rest[1] else []
        return place

    def read(self, place: FilePlace) -> tuple[bytes, ...]:
        """The parts of a frame."""
        assert self._file is not None
        self._file.seek(place.start)
        return tuple(self._file.read(size) for size in place.sizes)

    def release(self, place: FilePlace) -> None:
        """Give the room of a frame to later ones."""
        if place.end == place.start:
            return
        insort(self._free, (place.start, place.end))
        joined: list[tuple[int, int]] = []
        for start, end in self._free:
            if joined and joined[-1][1] == start:
                joined[-1] = joined[-1][0], end
            else:
                joined.append((start, end))
        if joined[-1][1] == self._end:  # what is written next goes there
            self._end = joined.pop()[0]
        self._free = joined
