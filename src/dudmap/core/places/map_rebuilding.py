"""Rebuilding of a map from the stored frames of its submap, a few of them with every frame that comes.

A map must be fused anew when its poses are corrected (Whelan et al. 2015, ElasticFusion, deform the surface instead;
Dai et al. 2017, BundleFusion, re-integrate frame by frame, as here). Order matters, since later frames carve what
earlier ones show, so that the new map is fused in the order of time and used when it is complete. Until then frames are
registered to a provisional map of those stored frames that see what the camera sees.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore

MAX_IMMEDIATE = 24
"""A map of at most this many stored frames is rebuilt at once, of a larger one those nearest to the present view."""
PER_FRAME = 2
"""Stored frames that are fused with every later frame, one of them into the provisional map where one is near. At most
one is stored with a frame, so that the rebuilding ends."""
MAX_ADDED = 8
"""Stored frames that are added to the provisional map at once where a lost camera may be."""
VIEW_DEPTH = 2.0
"""Depth of the point for comparing views, reference depths: the middle of an indoor view."""
NEAR = 3.0
"""Largest distance between the points in the middle of the view and of a stored frame, reference depths. Nearer frames
are added to the provisional map. Others show surface out of view; they are added when the camera approaches."""
SPACING = 0.3
"""Smallest distance, reference depths, between the points that two added frames look at: nearer ones see the same."""


@dataclass(eq=False)
class MapRebuilding:
    """A new map of a submap, not complete yet; it also gets all frames from now on.

    Attributes:
        history: The stored frames.
        submap: Number of the submap.
        volume: Its new map.
        fused: Numbers of the stored frames of the submap that this holds.
        shown: Those that the provisional map holds, or does not need beside them.
        start: Number of stored frames when the rebuilding began.
    """

    history: FrameStore
    submap: int
    volume: TsdfVolume
    fused: set[int]
    shown: set[int]
    start: int

    @classmethod
    def of(cls, history: FrameStore, submap: int, volume: TsdfVolume, shown: Iterable[int] = ()) -> "MapRebuilding":
        """A rebuilding that begins now, with some frames in the provisional map."""
        return cls(history, submap, volume, set(), set(shown), len(history))

    @property
    def missing(self) -> list[int]:
        """Numbers of the stored frames that the new map lacks, in order of time."""
        return [n for n in self.history.kept_of(self.submap) if n not in self.fused]

    def fuse(self, count: int | None = None) -> bool:
        """Fuse the next stored frames, None = all, into the new map; returns whether it is complete now."""
        missing = self.missing
        for n in missing[:count]:
            self.history.reintegrate(self.volume, [n])
            self.fused.add(n)
        return count is None or len(missing) <= count

    def add_shown(self, numbers: Sequence[int]) -> None:
        """Note that the provisional map holds stored frames of these numbers, too."""
        self.shown.update(numbers)

    def show(self, provisional: TsdfVolume, T_world_camera: NDArray[np.float64], count: int) -> int:
        """Add those stored frames to the provisional map, at most ``count``, that see what a camera sees; returns how
        many."""
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
    """Numbers, in order, of the poses (n, 4, 4), at most ``count``, whose view is nearest to that of a camera."""
    return np.sort(np.argsort(view_distances(Ts, T_world_camera, unit), kind="stable")[:count])


def view_distances(
    Ts: NDArray[np.float64], T_world_camera: NDArray[np.float64], unit: float = 1.0
) -> NDArray[np.float64]:
    """Distances (n,) between the view points of poses (n, 4, 4) and of a camera, metres; ``unit``: reference depth."""
    return np.linalg.norm(_looked_at(Ts, unit) - _looked_at(T_world_camera, unit), axis=-1)


def _looked_at(Ts_world_camera: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """Points (..., 3) on the optical axes at ``VIEW_DEPTH``."""
    return Ts_world_camera[..., :3, 3] + VIEW_DEPTH * unit * Ts_world_camera[..., :3, 2]
