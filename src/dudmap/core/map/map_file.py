"""Map file: a NumPy archive written in parts, so that the map need not be in memory as a whole."""

import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from dudmap.atomic_file import atomic_file
from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.voxel_blocks import BLOCK, VoxelBlocks
from dudmap.errors import MapError
from dudmap.gone_keys import without_gone
from dudmap.input_files import DAMAGE, open_arrays

if TYPE_CHECKING:
    from dudmap.core.map.volume import TsdfVolume

FORMAT = "dudmap map 1"
VOXELS = "geometry", "colors"
LARGEST_DEPTH = 1000.0
"""Largest depth range of a map file, metres: the steps of a ray cast grow with it."""


def write_map(path: str | Path, volume: "TsdfVolume") -> None:
    """Write a map; an older file is replaced when the new one is complete.

    Raises:
        MapError: The file cannot be written.
    """
    camera = volume.camera
    coords, free_count, entries, first = [], [], [], 0
    finer: list[list[NDArray[np.int32]]] = [[] for _ in volume.levels]
    for part in volume.records():
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
        "config": volume.config.model_dump_json(),
        "sensor": volume.sensor.model_dump_json(),
        "depth_max": volume.depth_max,
        "frames": volume.num_frames,
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
                _write_array(archive, name, np.int32, shape, (getattr(part, name) for part in volume.records()))
            for n, level in enumerate(finer):
                places = np.concatenate(level)
                _write_array(archive, f"slot_coords{n + 1}", np.int32, places.shape, iter([places]))
                for name in VOXELS:
                    parts = (getattr(part.finer[n], name) for part in volume.records() if n < len(part.finer))
                    _write_array(archive, f"{name}{n + 1}", np.int32, (len(places), BLOCK**3), parts)
    except OSError as error:
        raise MapError(f"cannot write the map to {path}: {error}") from error


def _write_array(
    archive: zipfile.ZipFile, name: str, dtype: DTypeLike, shape: tuple[int, ...], parts: Iterator[NDArray]
) -> None:
    """Add an array that comes in parts along its first axis, in the form of ``numpy.savez_compressed``."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(member, header)
        for part in parts:
            member.write(np.ascontiguousarray(part).data)


def read_map(path: str | Path) -> "TsdfVolume":
    """Read a map that ``write_map`` wrote.

    Raises:
        MapError: The file is missing, damaged or not a map of this version.
    """
    from dudmap.core.map.adaptive_volume import make_volume

    try:
        with open_arrays(path) as data:
            parameters = read_parameters(data, path)
            blocks = VoxelBlocks.restored(*(data[name] for name in ("coords", "free_count", "entries", *VOXELS)))
            finer = _read_levels(data)
            frames = int(data["frames"]) if "frames" in set(data) else 0
    except DAMAGE as error:
        raise MapError(f"{path} is not a readable map file: {error}") from error
    volume = make_volume(*parameters)
    volume.blocks, volume.num_frames = blocks, max(frames, 0)
    if len(finer) > len(volume.levels):
        raise MapError(
            f"the map is damaged: it has {len(finer)} levels of smaller voxels, its configuration allows "
            f"{len(volume.levels)}"
        )
    for number, level in enumerate(volume.levels[: len(finer)]):
        level.blocks = finer[number]
        if not np.all(level.link(volume.all_blocks.parents[number])):  # the parents were just read
            raise MapError(f"the map is damaged: blocks with voxels of {level.voxel_size} m have no parent block")
    for level, parents in zip(volume.levels, volume.all_blocks.parents, strict=True):
        level.make_room(parents)
    return volume


def read_parameters(data: Mapping[str, NDArray], path: str | Path) -> tuple[Camera, VolumeConfig, SensorConfig, float]:
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
    return Camera(fx, fy, cx, cy, width, height), config, sensor, float(data["depth_max"])


def _read_levels(data: Mapping[str, NDArray]) -> list[VoxelBlocks]:
    """Blocks with smaller voxels, level by level.

    Raises:
        ValueError: Their arrays do not fit each other.
    """
    levels, names = [], set(data)
    while f"slot_coords{len(levels) + 1}" in names:
        number = len(levels) + 1
        coords = data[f"slot_coords{number}"]
        free, entries = np.zeros(len(coords), np.uint8), np.arange(len(coords), dtype=np.int32)
        levels.append(VoxelBlocks.restored(coords, free, entries, data[f"geometry{number}"], data[f"colors{number}"]))
    return levels
