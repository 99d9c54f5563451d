"""A depth image on its way into the voxels: allocate, average (eq. 4.18-4.23), carve, remember free space."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.kernels import integration, visibility
from dudmap.kernels.threads import bands, run_bands
from dudmap.mapping.voxel_blocks import BLOCK

if TYPE_CHECKING:
    from dudmap.mapping.volume import TsdfVolume

NEAREST = 0.05
"""Blocks nearer to the camera than this are not seen, metres."""


class Integrator:
    """One frame that is fused into a map.

    Args:
        volume: The map, whose window has been moved to the view.
        depth: (H, W) float32, metres, 0 where nothing is to be fused.
        T_world_camera: (4, 4).
        number: Number of the frame among those of the map.
    """

    def __init__(
        self, volume: "TsdfVolume", depth: NDArray[np.float32], T_world_camera: NDArray[np.float64], number: int
    ) -> None:
        self.volume = volume
        self.depth = depth
        self.number = number
        self.T_lattice_camera = volume.window.T_grid_camera(T_world_camera)
        self.T_camera_world = se3.inverse(T_world_camera)[:3].astype(np.float32)
        self.size = np.array(depth.shape, dtype=np.int64)
        tiles = -(-depth.shape[0] // visibility.TILE), -(-depth.shape[1] // visibility.TILE)
        self.tiles = tuple(np.empty(tiles, dtype=np.float32) for _ in range(3))  # nearest, farthest, share of readings
        run_bands(
            lambda start, stop: visibility.tile_ranges(start, stop, depth, *self.tiles),
            bands(tiles[0], 15),
        )
        sensor, config = volume.sensor, volume.config
        self.band = np.array(
            [
                volume.truncation, volume.truncation_behind, config.truncation_noise, sensor.sigma_base,
                sensor.sigma_scale, volume.block_size,
            ],
            dtype=np.float32,
        )  # fmt: skip

    def allocate(self) -> None:
        """Give voxels to the blocks that the truncation band of the image touches."""
        volume, depth, window, blocks = self.volume, self.depth, self.volume.window, self.volume.blocks
        T = self.T_lattice_camera / np.float32(BLOCK)
        farthest = max(float(depth.max()), 0.05)
        stride = int(np.clip(0.5 * volume.block_size * volume.camera.fx / farthest, 1, 8))  # half a block, or less
        ranges = bands(-(-depth.shape[0] // stride), 15)
        found = [np.empty(1 << 16, dtype=np.int32) for _ in ranges]
        counts = run_bands(
            lambda start, stop, out: visibility.mark_blocks(
                stride * start, min(stride * stop, depth.shape[0]), stride, depth, volume.camera.intrinsics, T,
                window.shape, window.cells, blocks.free_count, volume.config.free_after, self.number, window.stamps,
                self.band, out,
            ),
            ranges, found,
        )  # fmt: skip
        cells = np.unique(np.concatenate([out[:count] for out, count in zip(found, counts, strict=True)]))
        if len(cells):
            window.give_voxels(cells, blocks, self.number)

    def average(self, color: NDArray[np.uint8], weights: NDArray[np.uint8], count: int) -> None:
        """Average distances and colours (H, W, 3) into the voxels in view; free what is empty.

        Each reading counts by its weight (H, W), as though ``count`` frames had shown it.
        """
        volume, window, blocks, config = self.volume, self.volume.window, self.volume.blocks, self.volume.config
        if len(window.near) == 0:
            return
        visible, repeats = self._visible()
        repeats *= count
        blocks.written[visible] = self.number
        blocks.fused[visible] = np.minimum(blocks.fused[visible], 254) + 1
        voxel = np.array(
            [
                volume.voxel_size, volume.sdf_unit, volume.truncation, volume.truncation_behind,
                config.truncation_noise, volume.sensor.sigma_base, volume.sensor.sigma_scale, config.max_weight,
                config.carve_rate if config.carving else 1, volume.largest, volume.depth_unit,
                config.max_readings,
            ],
            dtype=np.float32,
        )  # fmt: skip
        pixels = self._pixels(color, weights)
        occupied = np.empty(len(visible), dtype=np.int32)
        run_bands(
            lambda start, stop: integration.integrate(
                start, stop, visible, repeats, blocks.slot_coords, self.T_camera_world, volume.camera.intrinsics,
                self.size, pixels, blocks.geometry.reshape(-1), blocks.colors.reshape(-1), voxel, occupied,
            ),
            bands(len(visible), 256),
        )  # fmt: skip
        if config.carving:
            window.take_voxels(visible[occupied == 0], blocks, config.free_after)

    def observe_free(self, count: int) -> None:
        """Count ``count`` more observations of emptiness for blocks without voxels in front of the image.

        Each call visits every second plane of the window, so that the cost is spread over two frames.
        """
        volume, window, blocks = self.volume, self.volume.window, self.volume.blocks
        assert window.origin is not None
        nearest, _, valid = self.tiles
        parity = self.number % 2
        ranges = bands(int(window.shape[0]) // 2, 8)
        found = [np.empty(1 << 16, dtype=np.int32) for _ in ranges]
        numbers = run_bands(
            lambda start, stop, out: visibility.observe_free(
                2 * start + parity, 2 * stop + parity, 2, window.cells, window.shape, window.origin,
                self.T_camera_world, volume.camera.intrinsics, self.size, np.float32(volume.block_size), nearest,
                valid, self.band, np.float32(volume.depth_max), blocks.free_count, count, volume.config.free_after,
                out,
            ),
            ranges, found,
        )  # fmt: skip
        cells = np.concatenate([out[:number] for out, number in zip(found, numbers, strict=True)])
        window.set_free(cells, blocks, count)

    def _visible(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Slots (n,) that the image may change in this frame, and for how many frames each of them counts."""
        volume, near, blocks = self.volume, self.volume.window.near, self.volume.blocks
        nearest, farthest, _ = self.tiles
        slots, repeats = np.empty(len(near), dtype=np.int32), np.empty(len(near), dtype=np.float32)
        turn = self.number if volume.config.take_turns else -1
        ranges = bands(len(near), 2048)
        counts = run_bands(
            lambda start, stop: visibility.visible_slots(
                start, stop, near, blocks.slot_coords, blocks.fused, turn, self.T_camera_world,
                volume.camera.intrinsics, self.size, np.float32(volume.block_size), nearest, farthest, self.band,
                np.float32(NEAREST), np.float32(volume.depth_max), slots, repeats,
            ),
            ranges,
        )  # fmt: skip
        taken = [np.s_[start : start + n] for (start, _), n in zip(ranges, counts, strict=True)]
        return np.concatenate([slots[part] for part in taken]), np.concatenate([repeats[part] for part in taken])

    def _pixels(self, color: NDArray[np.uint8], weights: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Readings and colours (H * W + 1,) as the kernel takes them; the last pixel has no reading."""
        volume, depth = self.volume, self.depth
        pixels, rgb = volume.pixel_buffer(depth.size + 1), np.ascontiguousarray(color)
        limits = np.array(
            [
                volume.truncation, volume.config.truncation_noise, volume.sensor.sigma_base,
                volume.sensor.sigma_scale, volume.largest, volume.depth_unit,
            ],
            dtype=np.float32,
        )  # fmt: skip
        run_bands(
            lambda start, stop: integration.pack_pixels(start, stop, depth, rgb, weights, limits, pixels),
            bands(depth.shape[0], 60),
        )
        return pixels.view(np.int64).reshape(-1)


def reading_weights(
    depth: NDArray[np.float32], camera: Camera, config: VolumeConfig, sensor: SensorConfig
) -> NDArray[np.uint8]:
    """Weights (H, W) of the readings: all alike, or by the angle of sight and the sensor's noise (eq. 4.20)."""
    weights = np.ones(depth.shape, dtype=np.uint8)
    if config.weighting == "angle":
        run_bands(
            lambda start, stop: integration.observation_weights(
                start, stop, depth, camera.intrinsics, np.float32(sensor.sigma_base), np.float32(sensor.sigma_scale),
                np.float32(4), weights,
            ),
            bands(depth.shape[0], 60),
        )  # fmt: skip
    return weights
