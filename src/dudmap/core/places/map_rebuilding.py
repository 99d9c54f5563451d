"""Rebuilding of a map from the stored frames of its submap, a few with every new frame.

Frames are re-integrated in order of time, because later frames carve (BundleFusion, Dai et al. 2017). Meanwhile frames
are registered to a provisional map of the present view.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore

MAX_IMMEDIATE = 24
"""Stored frames fused at once, nearest to the view first."""
PER_FRAME = 2
"""Stored frames fused with every later frame; at most one is stored per frame."""
MAX_ADDED = 8
"""Stored frames added at once around a candidate pose of a lost camera."""
VIEW_DEPTH = 2.0
"""Depth of the view point that stands for a view, reference depths."""
NEAR = 3.0
"""Largest distance of an added frame's view point from the camera's, reference depths."""
SPACING = 0.3
"""Smallest distance between view points of added frames, reference depths."""


@dataclass(eq=False)
class MapRebuilding:
    """An incomplete new map of a submap, which also receives all new frames.

    Attributes:
        shown: Stored frames that the provisional map has or does not need.
        start: Stored frames when the rebuilding began.
    """

    history: FrameStore
    submap: int
    volume: TsdfVolume
    fused: set[int]
    shown: set[int]
    start: int

    @classmethod
    def of(cls, history: FrameStore, submap: int, volume: TsdfVolume, shown: Iterable[int] = ()) -> "MapRebuilding":
        """A rebuilding that begins now; the provisional map has the frames ``shown``."""
        return cls(history, submap, volume, set(), set(shown), len(history))

    @property
    def missing(self) -> list[int]:
        """Stored frames that the new map lacks, in order of time."""
        return [n for n in self.history.kept_of(self.submap) if n not in self.fused]

    def fuse(self, count: int | None = None) -> bool:
        """Fuse the next ``count`` stored frames (None = all); returns whether the map is complete."""
        missing = self.missing
        for n in missing[:count]:
            self.history.reintegrate(self.volume, [n])
            self.fused.add(n)
        return count is None or len(missing) <= count

    def add_shown(self, numbers: Sequence[int]) -> None:
        """Record frames of the provisional map."""
        self.shown.update(numbers)

    def show(self, provisional: TsdfVolume, T_world_camera: NDArray[np.float64], count: int) -> int:
        """Add at most ``count`` frames with the view of a camera to the provisional map; returns their number."""
        unknown = np.array([n for n in self.history.kept_of(self.submap) if n < self.start and n not in self.shown])
        unknown = unknown.astype(int)
        unit = self.volume.sensor.reference_depth
        points = _looked_at(np.reshape([self.history.frames[n].T_world_camera for n in unknown], (-1, 4, 4)), unit)
        here = _looked_at(T_world_camera, unit)
        added: list[int] = []
        while len(unknown) and len(added) < count:
            distances = np.linalg.norm(points - here, axis=1)
            nearest = int(np.argmin(distances))
            if distances[nearest] > NEAR * unit:
                break
            added.append(int(unknown[nearest]))
            same = np.linalg.norm(points - points[nearest], axis=1) < SPACING * unit
            self.shown.update(unknown[same].tolist())
            unknown, points = unknown[~same], points[~same]
        self.history.reintegrate(provisional, sorted(added))
        return len(added)


def nearest_views(
    Ts: NDArray[np.float64], T_world_camera: NDArray[np.float64], count: int, unit: float = 1.0
) -> NDArray[np.int64]:
    """Sorted indices of at most ``count`` poses (n, 4, 4) with views nearest to a camera's."""
    return np.sort(np.argsort(view_distances(Ts, T_world_camera, unit), kind="stable")[:count])


def view_distances(
    Ts: NDArray[np.float64], T_world_camera: NDArray[np.float64], unit: float = 1.0
) -> NDArray[np.float64]:
    """Distances (n,) of the view points of poses (n, 4, 4) from a camera's, metres; ``unit``: reference depth."""
    return np.linalg.norm(_looked_at(Ts, unit) - _looked_at(T_world_camera, unit), axis=-1)


def _looked_at(Ts_world_camera: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    return Ts_world_camera[..., :3, 3] + VIEW_DEPTH * unit * Ts_world_camera[..., :3, 2]
