"""What a stored frame shows, coarsely: a grid of its readings, and whether frames from nearby saw the same."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry.camera import Camera

DEPTH_UNIT = 0.0005
"""Step of the stored depth, metres. The quantisation error, 0.29 steps rms, is 0.14 mm: a seventh of ``sigma_base``."""
COLUMNS = 16
"""Columns of the grid. A cell of 63 degrees of view is 4 degrees wide: less than ``loops.keep_angle_deg``, by
which stored frames of one place differ anyway."""
FLAT_SHARE, FLAT = 0.02, 0.02
"""The 3x3 readings around a pixel lie on one surface if they differ by less than this share of the depth, plus this in
metres. Others (edges, single readings) say where the surface is by chance only."""


@dataclass(frozen=True, eq=False)
class Glimpse:
    """Static readings at the centres of the cells of a grid over the image, row by row.

    Attributes:
        steps: (n,) uint16, depth in steps of ``DEPTH_UNIT``, 0 = no static reading.
        certain: (n,) bool, whether the reading lies on one surface with its neighbours.
    """

    steps: NDArray[np.uint16]
    certain: NDArray[np.bool_]

    @classmethod
    def of(cls, depth: NDArray[np.float32], static: NDArray[np.bool_]) -> "Glimpse":
        """That of a depth image (H, W) in metres and the mask (H, W) of its static pixels."""
        return cls.of_steps(depth_steps(_around(depth)), _around(static))

    @classmethod
    def of_stored(cls, steps: NDArray[np.uint16], static: NDArray[np.bool_]) -> "Glimpse":
        """The same of a depth image (H, W) as it is stored, in steps."""
        return cls.of_steps(_around(steps), _around(static))

    @classmethod
    def of_steps(cls, steps: NDArray[np.uint16], static: NDArray[np.bool_]) -> "Glimpse":
        """That of the 3x3 readings (9, n) around the pixels of the grid."""
        readings = np.where(static, steps, np.uint16(0))
        low, high = readings.min(axis=0).astype(np.float32), readings.max(axis=0).astype(np.float32)
        certain = (low > 0) & (high - low < FLAT / DEPTH_UNIT + FLAT_SHARE * readings[4])
        return cls(readings[4].copy(), certain)


@dataclass(frozen=True, eq=False)
class Visibility:
    """Decides which readings of one frame others saw again.

    Args:
        camera: Of all frames.
        config: Used are ``volume`` and ``sensor``, which give the truncation band.
    """

    camera: Camera
    config: Config

    def points(self, glimpse: Glimpse) -> NDArray[np.float64]:
        """Points (n, 3), camera frame: certain readings, and the middle of the free space before each."""
        v, u = pixels(self.camera.shape)
        known = glimpse.certain
        surface = self.camera.points(u[known], v[known], glimpse.steps[known] * DEPTH_UNIT)
        return np.concatenate([surface, 0.5 * surface]).astype(np.float64)

    def observed(
        self, points: NDArray[np.float64], Ts: NDArray[np.float64], glimpses: Sequence[Glimpse]
    ) -> NDArray[np.bool_]:
        """Which points (n, 3) of one frame other frames saw again (m, n): to a reading at the point or behind it.

        This is the condition under which the fusion changes a voxel (``fuse_voxel``): the point lies in front of the
        reading of its pixel, or behind it by less than the truncation band.

        Args:
            points: Camera frame of the one.
            Ts: (m, 4, 4), from there to the camera frames of the others.
            glimpses: m, of the others.
        """
        volume = self.config.volume
        row, column, z = self._cells(points, Ts)
        inside = self._is_inside(row, column, z)
        cell = np.where(inside, row * grid_shape(self.camera.shape)[1] + column, 0).astype(np.int64)
        depth = np.take_along_axis(np.stack([one.steps for one in glimpses]) * DEPTH_UNIT, cell, axis=1)
        noise = volume.truncation_noise * self.config.sensor.sigma(depth)
        band = np.maximum(volume.truncation_behind_voxels * volume.voxel_size, noise)
        return inside & (depth > 0) & (depth - z > -band)

    def in_view(self, points: NDArray[np.float64], Ts: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) of one frame lie in the images of others (m, n), given the motions (m, 4, 4) to them."""
        return self._is_inside(*self._cells(points, Ts))

    def _cells(self, points: NDArray[np.float64], Ts: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Rows, columns and depths (m, n) of points in the grids of other frames."""
        # pixel centres lie at whole numbers
        camera, (rows, columns) = self.camera, grid_shape(self.camera.shape)
        there = np.einsum("mij,nj->imn", Ts[:, :3, :3], points) + np.moveaxis(Ts[:, :3, 3:], 1, 0)
        by_z = 1 / np.maximum(there[2], 1e-6)
        row = np.floor((there[1] * by_z * camera.fy + camera.cy + 0.5) * rows / camera.height)
        column = np.floor((there[0] * by_z * camera.fx + camera.cx + 0.5) * columns / camera.width)
        return row, column, there[2]

    def _is_inside(
        self, row: NDArray[np.float64], column: NDArray[np.float64], z: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        rows, columns = grid_shape(self.camera.shape)
        return (z > 0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)


def depth_steps(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depths in metres as they are stored."""
    return np.minimum(depth * np.float32(1 / DEPTH_UNIT) + np.float32(0.5), 65535).astype(np.uint16)


def grid_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the grid over an image (height, width); its cells are about square."""
    height, width = shape
    return max(round(COLUMNS * height / width), 1), COLUMNS


def pixels(shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (n,) of the pixels in the middle of the cells, not at the border of the image."""
    height, width = shape
    rows, columns = grid_shape((height, width))
    v = np.clip((np.arange(rows) + 0.5) * height / rows, 1, height - 2).astype(np.int64)
    u = np.clip((np.arange(columns) + 0.5) * width / columns, 1, width - 2).astype(np.int64)
    v, u = np.meshgrid(v, u, indexing="ij")
    return v.reshape(-1), u.reshape(-1)


def _around(image: NDArray) -> NDArray:
    """Values (9, n) of the 3x3 pixels around those of the grid over an image (H, W)."""
    v, u = pixels(image.shape)
    return np.stack([image[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
