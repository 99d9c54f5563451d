"""Rebuilding of a map from the stored frames of its submap, a few of them with every frame that comes.

A map must be fused anew when its poses are corrected (Whelan et al. 2015, ElasticFusion, deform the surface instead;
Dai et al. 2017, BundleFusion, re-integrate frame by frame, as here). Order matters, since later frames carve what
earlier ones show, so that the new map is fused in the order of time and used when it is complete. Until then frames are
registered to a provisional map of those stored frames that see what the camera sees.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore

AT_ONCE = 24
"""A map of at most this many stored frames is rebuilt at once, of a larger one those nearest to the present view."""
PER_FRAME = 2
"""Stored frames that are fused with every later frame, one of them into the provisional map where one is near. At most
one is stored with a frame, so that the rebuilding ends."""
SHOWN = 8
"""Stored frames that are added to the provisional map at once where a lost camera may be."""
VIEW_DEPTH = 2.0
"""Depth of the point by which views are compared, metres: the middle of what a camera sees indoors."""
NEAR = 3.0
"""Stored frames whose point is farther than this from that of the view are not added to the provisional map, metres:
what they see is out of view, or is added as the camera goes there."""
SPACING = 0.3
"""Nor are those whose point is nearer than this to that of one which was added, metres: they see the same."""


class MapRebuilding:
    """A new map of a submap, not complete yet; it also gets all frames from now on.

    ``fused`` are the numbers of the stored frames of the submap that it holds, ``shown`` those that the provisional map
    holds, or does not need beside them.
    """

    def __init__(
        self, history: FrameStore, submap: int, volume: TsdfVolume, fused: Sequence[int], shown: Sequence[int]
    ) -> None:
        self.history = history
        self.submap = submap
        self.volume = volume
        self._fused, self._shown = set(fused), set(shown)
        self._start = len(history)

    @property
    def missing(self) -> list[int]:
        """Numbers of the stored frames that the new map lacks, in order of time."""
        return [n for n in self.history.kept_of(self.submap) if n not in self._fused]

    def fuse(self, count: int | None = None) -> bool:
        """Fuse the next stored frames, None = all, into the new map; returns whether it is complete now."""
        missing = self.missing
        for n in missing[:count]:
            self.history.reintegrate(self.volume, [n])
            self._fused.add(n)
        return count is None or len(missing) <= count

    def restarted(self, shown: Sequence[int]) -> "MapRebuilding":
        """The same with another provisional map, which holds the stored frames of these numbers."""
        return MapRebuilding(self.history, self.submap, self.volume, sorted(self._fused), shown)

    def add_shown(self, numbers: Sequence[int]) -> None:
        """Note that the provisional map holds stored frames of these numbers, too."""
        self._shown.update(numbers)

    def show(self, provisional: TsdfVolume, T_world_camera: NDArray[np.float64], count: int) -> int:
        """Add those stored frames to the provisional map, at most ``count``, that see what a camera sees; returns how
        many."""
        unknown = np.array([n for n in self.history.kept_of(self.submap) if n < self._start and n not in self._shown])
        unknown = unknown.astype(int)
        points = _looked_at(np.reshape([self.history.Ts_world_camera[n] for n in unknown], (-1, 4, 4)))
        here = _looked_at(T_world_camera)
        added: list[int] = []
        while len(unknown) and len(added) < count:
            distances = np.linalg.norm(points - here, axis=1)
            nearest = int(np.argmin(distances))
            if distances[nearest] > NEAR:
                break
            added.append(int(unknown[nearest]))
            same = np.linalg.norm(points - points[nearest], axis=1) < SPACING
            self._shown.update(unknown[same].tolist())
            unknown, points = unknown[~same], points[~same]
        self.history.reintegrate(provisional, sorted(added))
        return len(added)


def nearest_views(Ts: NDArray[np.float64], T_world_camera: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Numbers, in order, of the poses (n, 4, 4), at most ``count``, whose view is nearest to that of a camera."""
    return np.sort(np.argsort(view_distances(Ts, T_world_camera), kind="stable")[:count])


def view_distances(Ts: NDArray[np.float64], T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n,) of what poses (n, 4, 4) look at from what a camera looks at, metres."""
    return np.linalg.norm(_looked_at(Ts) - _looked_at(T_world_camera), axis=-1)


def _looked_at(Ts_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 3) on the optical axes at ``VIEW_DEPTH``."""
    return Ts_world_camera[..., :3, 3] + VIEW_DEPTH * Ts_world_camera[..., :3, 2]
