"""Redundant views: frames without new information, which are not fused (thesis section 4.3).

The map's weights measure the information directly; the thesis compares SIFT features.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.detector import MIN_REGION, depth_tolerance, distance_sigma, noise_threshold
from dudmap.core.dynamics.masks import opened_mask
from dudmap.core.frames.observation import Level
from dudmap.core.geometry.se3 import agree
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate

MAX_ROTATION_DEG = 0.3
"""Rotation since the last fused frame above which a view is new, degrees: 0.7 label pixels."""


@dataclass(eq=False)
class _Place:
    """Frames fused from one place.

    Attributes:
        T_world_camera: (4, 4) pose of the first of them.
        depth: (h, w) float32, metres, last fused static measurement; 0 = none.
        to_carve: (h, w), number of further frames to fuse at each pixel, to carve an object that left.
    """

    T_world_camera: NDArray[np.float64]
    depth: NDArray[np.float32]
    to_carve: NDArray[np.int64]


class RedundantViews(Stateful):
    """Decides which frames are not fused because the map has their information.

    A view is redundant only at the place of the last fused frames: elsewhere systematic errors differ.
    """

    _place: Remembered[_Place | None] = None

    def __init__(self, config: Config) -> None:
        self.config = config
        self._learnt = 2 * config.volume.free_after

    def is_redundant(self, volume: TsdfVolume, view: FrameView, estimate: PoseEstimate) -> bool:
        """Whether to leave a registered frame out of the fusion.

        The map must have on average more than ``similarity.threshold`` of the information on visible static surface,
        except for

        * a surface with fewer than 2 ``volume.free_after`` observations, because the space before it is not yet known
          to be free (each frame observes every second plane of blocks)
        * measurements off the map surface: a new object
        * measurements behind the last fused depth, until fused as often: an object left and is carved
        """
        place, config, level = self._place, self.config.similarity, view.labelled
        if place is None or not config.enabled or not self._is_near(place, estimate.T_world_camera):
            return False
        static = _static(view, estimate)
        known = self._known_share(volume, level, estimate.T_world_camera)
        if not static.any() or known[static].mean() <= config.threshold:
            return False
        to_carve = self._is_behind(place, level, volume) | (place.to_carve > 0)
        unfused = static & ((known < self._learnt / (self._learnt + 1)) | to_carve)
        return bool(np.count_nonzero(opened_mask(unfused, level)) < MIN_REGION * unfused.size)

    def update(self, volume: TsdfVolume, view: FrameView, estimate: PoseEstimate) -> None:
        """Record a fused frame."""
        config, level, T_world_camera = self.config.similarity, view.labelled, estimate.T_world_camera
        if not config.enabled:
            return
        place = self._place
        static = _static(view, estimate)
        if place is None or not self._is_near(place, T_world_camera):
            depth, to_carve = np.where(static, level.depth, np.float32(0)), np.zeros(level.depth.shape, np.int64)
            self._place = _Place(T_world_camera, depth, to_carve)
            return
        behind = self._is_behind(place, level, volume)
        remaining = np.where(behind, self._learnt, place.to_carve) - 1
        place.to_carve = np.where(static, np.maximum(remaining, 0), place.to_carve)
        place.depth = np.where(static, level.depth, place.depth)

    def apply_correction(self, T_new_old: NDArray[np.float64]) -> None:
        """Move the place with a correction (4, 4) of the world."""
        if self._place is not None:
            self._place.T_world_camera = T_new_old @ self._place.T_world_camera

    def reset(self) -> None:
        """Forget the place."""
        self._place = None

    def _known_share(
        self, volume: TsdfVolume, level: Level, T_world_camera: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        volume.look_at(T_world_camera)
        sample = volume.sample(level.depth, level.intensity, level.camera, T_world_camera)
        sigma = distance_sigma(self.config.sensor, level.depth, volume.voxel_size)
        on_surface = np.abs(sample.distance) < noise_threshold(self.config.sensor, sigma)
        return np.where(on_surface, volume.known_share(level.depth, level.camera, T_world_camera), np.float32(0))

    def _is_behind(self, place: _Place, level: Level, volume: TsdfVolume) -> NDArray[np.bool_]:
        sigma = distance_sigma(self.config.sensor, level.depth, volume.voxel_size)
        return (place.depth > 0) & (level.depth - place.depth > depth_tolerance(sigma, level))

    def _is_near(self, place: _Place, T_world_camera: NDArray[np.float64]) -> bool:
        config = self.config.similarity
        if config.max_translation == 0:
            return True
        return agree(place.T_world_camera, T_world_camera, config.max_translation, MAX_ROTATION_DEG)


def _static(view: FrameView, estimate: PoseEstimate) -> NDArray[np.bool_]:
    readings = view.labelled.depth > 0
    return readings if estimate.labels is None else readings & ~estimate.labels.dynamic
