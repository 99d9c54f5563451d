"""Map file: a NumPy archive written in parts, so that the map need not be in memory."""

import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from dudmap.atomic_file import atomic_file
from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.voxel_blocks import BLOCK, BlockRecords, VoxelBlocks
from dudmap.errors import MapError
from dudmap.gone_keys import without_gone
from dudmap.input_files import DAMAGE, open_arrays

FORMAT = "dudmap map 1"
VOXELS = "geometry", "colors"
LARGEST_DEPTH = 1000.0
"""Depth range of a map file, metres: the steps of a ray cast grow with it."""


class MapParameters(NamedTuple):
    """Camera, configuration, sensor, and largest depth in metres."""

    camera: Camera
    config: VolumeConfig
    sensor: SensorConfig
    depth_max: float


class MapContent(NamedTuple):
    """Content of a map file; ``finer``: blocks with smaller voxels, level by level."""

    parameters: MapParameters
    num_frames: int
    blocks: VoxelBlocks
    finer: list[VoxelBlocks]


def write_map(
    path: str | Path,
    parameters: MapParameters,
    num_frames: int,
    num_levels: int,
    records: Callable[[], Iterable[BlockRecords]],
) -> None:
    """Write a map; an older file is replaced when the new one is complete.

    Args:
        path: The file.
        parameters: Arguments of the map.
        num_frames: Integrated frames.
        num_levels: Levels of smaller voxels.
        records: Gives all blocks in parts, the same at each call.

    Raises:
        MapError: The file cannot be written.
    """
    camera = parameters.camera
    coords, free_count, entries, first = [], [], [], 0
    finer: list[list[NDArray[np.int32]]] = [[] for _ in range(num_levels)]
    for part in records():
        for level, blocks in zip(finer, part.finer, strict=False):
            level.append(blocks.coords)
        coords.append(part.coords.astype(np.int32))
        free_count.append(part.free_count)
        entries.append(part.owners + np.int32(first))
        first += len(part.coords)
        del part  # free this copy of the voxels before the next one is made
    small = {
        "format": FORMAT,
        "camera": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        "image": np.array([camera.width, camera.height]),
        "config": parameters.config.model_dump_json(),
        "sensor": parameters.sensor.model_dump_json(),
        "depth_max": parameters.depth_max,
        "frames": num_frames,
        "coords": np.concatenate(coords),
        "free_count": np.concatenate(free_count),
        "entries": np.concatenate(entries),
    }
    shape = len(small["entries"]), BLOCK**3
    try:
        with atomic_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=2) as archive:
            for name, value in small.items():
                array = np.asanyarray(value)
                _write_array(archive, name, array.dtype, array.shape, iter([array]))
            for name in VOXELS:
                _write_array(archive, name, np.int32, shape, (getattr(part, name) for part in records()))
            for n, level in enumerate(finer):
                places = np.concatenate(level)
                _write_array(archive, f"slot_coords{n + 1}", np.int32, places.shape, iter([places]))
                for name in VOXELS:
                    parts = (getattr(part.finer[n], name) for part in records() if n < len(part.finer))
                    _write_array(archive, f"{name}{n + 1}", np.int32, (len(places), BLOCK**3), parts)
    except OSError as error:
        raise MapError(f"cannot write the map to {path}: {error}") from error


def _write_array(
    archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: tuple[int, ...], parts: Iterator[NDArray]
) -> None:
    """Add an array that comes in parts along its first axis, as ``numpy.savez_compressed``."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(member, header)
        for part in parts:
            member.write(np.ascontiguousarray(part).data)


def read_map(path: str | Path) -> MapContent:
    """Read a map that ``write_map`` wrote.

    Raises:
        MapError: The file is missing, damaged or not a map of this version.
    """
    try:
        with open_arrays(path) as data:
            parameters = read_parameters(data, path)
            blocks = VoxelBlocks.restored(*(data[name] for name in ("coords", "free_count", "entries", *VOXELS)))
            frames = int(data["frames"]) if "frames" in set(data) else 0
            return MapContent(parameters, max(frames, 0), blocks, _read_levels(data))
    except DAMAGE as error:
        raise MapError(f"{path} is not a readable map file: {error}") from error


def read_parameters(data: Mapping[str, NDArray], path: str | Path) -> MapParameters:
    """Camera, configuration, sensor and largest depth (m) of an open map file.

    Raises:
        MapError: The file is a map of another version.
        ValueError: The values do not describe a map.
    """
    if str(data["format"]) != FORMAT:
        raise MapError(f"{path} is a map of format {str(data['format'])!r}; this version reads {FORMAT!r}")
    if not 0 < data["depth_max"] <= LARGEST_DEPTH:
        raise ValueError(f"its depths reach {data['depth_max']} m; expected up to {LARGEST_DEPTH:g} m")
    fx, fy, cx, cy = (float(value) for value in data["camera"])
    width, height = (int(value) for value in data["image"])
    config = VolumeConfig.model_validate(without_gone({"volume": json.loads(str(data["config"]))})["volume"])
    sensor = SensorConfig.model_validate_json(str(data["sensor"]))
    return MapParameters(Camera(fx, fy, cx, cy, width, height), config, sensor, float(data["depth_max"]))


def _read_levels(data: Mapping[str, NDArray]) -> list[VoxelBlocks]:
    levels, names = [], set(data)
    while f"slot_coords{len(levels) + 1}" in names:
        number = len(levels) + 1
        coords = data[f"slot_coords{number}"]
        free, entries = np.zeros(len(coords), np.uint8), np.arange(len(coords), dtype=np.int32)
        levels.append(VoxelBlocks.restored(coords, free, entries, data[f"geometry{number}"], data[f"colors{number}"]))
    return levels
