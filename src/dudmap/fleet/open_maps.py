"""What a worker keeps of the runs it works on: a few whole maps, and the small parts of more."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import Keyframe
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap, load_keyframes
from dudmap.fleet.inputs import MapHeader
from dudmap.fleet.map_fusion import ReachedBlocks
from dudmap.fleet.map_merging import MapSurface
from dudmap.fleet.map_samples import SurfacePoints

OPEN_MAPS = 2
"""Whole maps in memory: the two of a pair."""
SMALL_PARTS = 32
"""Runs whose keyframes (some MB), surface points (1 MB) or lists of blocks (some MB) are in memory."""


@lru_cache(maxsize=OPEN_MAPS)
def open_map(run: Path) -> TsdfVolume:
    """Map of a run."""
    return TsdfVolume.load(run / MAP_FILE)


@lru_cache(maxsize=SMALL_PARTS)
def keyframes_of(run: Path) -> list[Keyframe]:
    """Keyframes of a run."""
    return load_keyframes(run / KEYFRAME_FILE)[0]


def surface_of(run: Path) -> MapSurface:
    """Map of a run with points on its surface."""
    points = _points(run)  # opens the map if they are not known yet
    return MapSurface(open_map(run), points)


@lru_cache(maxsize=SMALL_PARTS)
def _points(run: Path) -> SurfacePoints:
    return MapSurface.of(SavedMap(open_map(run), keyframes_of(run))).points


@lru_cache(maxsize=SMALL_PARTS)
def reached_blocks(run: Path, pose: bytes) -> ReachedBlocks:
    """Blocks of the world that a run reaches; ``pose`` are the 128 bytes of its pose (4, 4)."""
    header = MapHeader.read(run / MAP_FILE)
    T = np.frombuffer(pose).reshape(4, 4)
    return ReachedBlocks.of(header.coords, header.has_voxels, T, header.volume().block_size)
