"""Checks of a merge's runs, worker processes, and their caches."""

import multiprocessing
import os
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.environment import peak_rss_mb
from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.map_file import read_parameters
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.place_recognition import Keyframe
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap, load_keyframes
from dudmap.errors import ConfigError, DudmapError, MapError
from dudmap.fleet.map_fusion import ReachedBlocks
from dudmap.fleet.map_merging import MapSurface
from dudmap.fleet.map_samples import SurfacePoints
from dudmap.input_files import DAMAGE, open_arrays

TRAJECTORY_FILE = "trajectory.txt"
MAX_RUNS = 8000
"""Runs: fusion sums have 32 bits (``BlockSums``)."""

OPEN_MAPS = 2
"""Whole maps in memory: a pair."""
SMALL_PARTS = 32
"""Runs in memory with keyframes, surface points (1 MB) or block lists."""

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class MapHeader:
    """A map file without voxels: parameters, block coordinates (n, 3), and which (n,) own voxels; the others are
    empty."""

    camera: Camera
    config: VolumeConfig
    sensor: SensorConfig
    depth_max: float
    coords: NDArray[np.int32]
    has_voxels: NDArray[np.bool_]

    @classmethod
    def read(cls, path: Path) -> "MapHeader":
        """Read a map file without decompressing voxels.

        Raises:
            MapError: The file is damaged or not a map of this version.
        """
        try:
            with open_arrays(path) as data:
                has_voxels = np.zeros(len(data["coords"]), bool)
                has_voxels[data["entries"]] = True
                return cls(*read_parameters(data, path), data["coords"], has_voxels)
        except DAMAGE as error:
            raise MapError(f"{path} is not a readable map file: {error}") from error

    def volume(self) -> TsdfVolume:
        """Empty map with these parameters."""
        return TsdfVolume(self.camera, self.config, self.sensor, self.depth_max)


def check_runs(runs: Sequence[Path], out: Path) -> MapHeader:
    """Check run folders before a merge; return the first map's parameters.

    Raises:
        ConfigError: Too few or many runs, one twice, or different voxel sizes.
        MapError: A run folder is incomplete or damaged.
        DudmapError: ``out`` is one of the runs.
    """
    if not 2 <= len(runs) <= MAX_RUNS:
        raise ConfigError(f"found {len(runs)} run folder(s) to merge; expected 2 to {MAX_RUNS}")
    twice = [path for path, count in Counter(path.resolve() for path in runs).items() if count > 1]
    if twice:
        raise ConfigError(f"the run folder {twice[0]} is named twice; name every run once")
    if out.resolve() in [path.resolve() for path in runs]:
        raise DudmapError(f"{out} is one of the runs to be merged; name another folder")
    for path in runs:
        missing = [name for name in (MAP_FILE, KEYFRAME_FILE, TRAJECTORY_FILE) if not (path / name).is_file()]
        if missing:
            raise MapError(f"{path} holds no {' and no '.join(missing)}; name a complete run folder")
        damaged = [name for name in (MAP_FILE, KEYFRAME_FILE) if not zipfile.is_zipfile(path / name)]
        if damaged:
            raise MapError(f"{path / damaged[0]} is cut off or damaged; repeat the run")
    headers = [MapHeader.read(path / MAP_FILE) for path in runs]
    sizes = [header.config.voxel_size for header in headers]
    for path, size in zip(runs, sizes, strict=True):
        if not np.isclose(size, sizes[0]):
            raise ConfigError(
                f"{runs[0]} has voxels of {sizes[0]:g} m and {path} of {size:g} m; repeat one with the other's "
                "volume.voxel_size"
            )
    return headers[0]


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
    points = _points(run)  # opens the map if the points are not cached
    return MapSurface(open_map(run), points)


@lru_cache(maxsize=SMALL_PARTS)
def _points(run: Path) -> SurfacePoints:
    return MapSurface.of(SavedMap(open_map(run), keyframes_of(run))).points


@lru_cache(maxsize=SMALL_PARTS)
def reached_blocks(run: Path, pose: bytes) -> ReachedBlocks:
    """Blocks of the world that a run at ``pose`` (128 bytes of (4, 4)) reaches."""
    header = MapHeader.read(run / MAP_FILE)
    T = np.frombuffer(pose).reshape(4, 4)
    return ReachedBlocks.of(header.coords, header.has_voxels, T, header.volume().block_size)


class Workers:
    """Processes with one thread each, or this process."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.peak_rss_mb: dict[int, float] = {}
        self.cpu_s = 0.0
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, context, initializer=_prepare) if count > 1 else None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[Result]:
        """Yield the results of jobs in their order.

        Raises:
            DudmapError: The system ended a worker, usually without memory.
        """
        if self._pool is None:
            measured = (_measured(function, job) for job in jobs)
        else:
            futures = [self._pool.submit(_measured, function, job) for job in jobs]
            measured = (future.result() for future in futures)
        try:
            for result, pid, peak, cpu in measured:
                if peak is not None:
                    self.peak_rss_mb[pid] = max(peak, self.peak_rss_mb.get(pid, 0.0))
                self.cpu_s += cpu
                yield result
        except BrokenProcessPool:
            raise DudmapError(
                f"a worker was ended by the system, perhaps for want of memory; repeat with fewer than {self.count} "
                "workers"
            ) from None


def _prepare() -> None:
    import cv2

    os.environ["DUDMAP_THREADS"] = "1"
    cv2.setNumThreads(1)


def _measured(function: Callable[[Job], Result], job: Job) -> tuple[Result, int, float | None, float]:
    start = time.process_time()
    result = function(job)
    return result, os.getpid(), peak_rss_mb(), time.process_time() - start
