"""Changed parts of a growing map, at a bounded cost."""

import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.incremental_mesh import Chunk, IncrementalMesh, VolumeMirror

if TYPE_CHECKING:
    from dudmap.core.map.volume import TsdfVolume

BUDGET_MS = 1.0
"""Milliseconds per frame for copying: a third of a viewer's allowance."""
BLOCKS = 512
LONGEST_WAIT = 15
"""Frames until another copy is allowed."""


@dataclass
class MeshChanges:
    """Changed parts of the mesh.

    Attributes:
        chunks: Mesh of each part; None if gone.
    """

    chunks: dict[Chunk, Mesh | None] = field(default_factory=dict)
    reset: bool = False


class MeshFeed:
    """Copies a growing map for a thread that extracts its mesh.

    Each frame adds ``budget_ms``; if that covers the last copy's cost, up to ``BLOCKS`` changed blocks are copied.
    """

    def __init__(self, budget_ms: float = BUDGET_MS) -> None:
        self._budget = budget_ms
        self._saved = self._cost = 0.0
        self._volume: TsdfVolume | None = None
        self._mirror: VolumeMirror | None = None
        self._extracted: VolumeMirror | None = None
        self._mesh: IncrementalMesh | None = None
        self._free = threading.Event()  # no copy waits for its extraction
        self._free.set()

    @property
    def has_copy(self) -> bool:
        """Whether ``take`` would return something new."""
        return not self._free.is_set()

    def offer(self, volume: "TsdfVolume", *, now: bool = False) -> None:
        """Copy changed blocks if budget and receiver allow; ``now``: once the receiver is ready."""
        self._saved += self._budget
        if now:
            self._free.wait()
        elif self.has_copy or self._saved < min(self._cost, LONGEST_WAIT * self._budget):
            return
        start = time.perf_counter()
        if self._mirror is None or self._volume is not volume:
            self._volume, self._mirror = volume, VolumeMirror(volume)
        self._mirror.update(None if now else BLOCKS)
        self._cost, self._saved = 1000 * (time.perf_counter() - start), 0.0
        self._free.clear()

    def take(self) -> MeshChanges:
        """Changes since the last call."""
        if not self.has_copy or self._mirror is None:
            return MeshChanges()
        reset = self._extracted is not self._mirror
        if self._mesh is None or reset:
            self._mesh, self._extracted = IncrementalMesh(self._mirror.volume), self._mirror
        try:
            changed = self._mesh.update()
            return MeshChanges({key: self._mesh.chunks.get(key) for key in changed}, reset)
        finally:
            self._free.set()

    def changes(self, volume: "TsdfVolume", *, now: bool = False) -> MeshChanges:
        """``offer`` and ``take`` in one thread."""
        start = time.perf_counter()
        self.offer(volume, now=now)
        if not self.has_copy:
            return MeshChanges()
        out = self.take()
        self._cost = 1000 * (time.perf_counter() - start)
        return out
