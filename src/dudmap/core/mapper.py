"""Fusion of frames with known poses, and the second registration of the first frames."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.masks import grown_mask
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import exposed_color
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.redundancy import RedundantViews
from dudmap.core.tracking.color_motion import ColorMotion, motion_discount
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, StageTimer, initial_weights
from dudmap.core.tracking.tracker import Tracker
from dudmap.core.young_map import WINDOW_STEP, StartFrame, YoungMap


class Mapper:
    """Fuses frames into the current map of the atlas.

    Args:
        config: All parameters.
        camera: Camera of the frames, without lens distortion.
        atlas: The maps.
        young_map: The first frames of the current map.
        color_motion: Registers colours by the velocity of the camera.
        redundancy: Records the fused views.
        localize: Frames are neither fused nor made keyframes.
    """

    def __init__(
        self,
        config: Config,
        camera: Camera,
        atlas: Atlas,
        young_map: YoungMap,
        color_motion: ColorMotion,
        redundancy: RedundantViews,
        *,
        localize: bool,
    ) -> None:
        self._config, self._camera, self._atlas, self._young_map = config, camera, atlas, young_map
        self._color_motion, self._redundancy = color_motion, redundancy
        self._localize = localize

    def recolor_first_frame(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Rebuild the map of the first frame with colours registered by the velocity to the second."""
        first = self._young_map.first
        if first is not None:
            colored = self._color_motion.first_frame(first.view, view.timestamp, estimate.T_world_camera)
            if colored is not None:
                self.begin_anew(self._young_map.recolored(colored), view.timer)

    def begin_anew(self, first: StartFrame, timer: StageTimer) -> None:
        """Rebuild the current map from its first frame."""
        self._atlas.clear_map()
        self._young_map.restart_window()
        mask = first.dynamic_mask | first.undecided_mask
        tracking = replace(first.estimate.tracking, T_world_camera=first.T_world_camera)
        self.integrate(replace(first.view, timer=timer), replace(first.estimate, tracking=tracking), mask)

    def extend(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_], *, fuse: bool) -> None:
        """Fuse a frame, and keep it as keyframe if none is near."""
        if fuse:
            self.integrate(view, estimate, dynamic_mask)
        if self._config.relocalization.enabled and not view.without_image:
            with view.timer("keyframe"):
                keyframes = self._atlas.keyframes
                place = view.colored(), estimate.T_world_camera, dynamic_mask, self._atlas.current
                keyframes.remember(*place)
                if not self._localize:
                    keyframes.add(*place)

    def refine_first_poses(self, tracker: Tracker) -> NDArray[np.float64] | None:
        """Register the first frames again to the more complete map, and rebuild it from them.

        The first frames followed the noise of a map of few frames. In the later map their own noise has little weight.
        Poses between refined frames are interpolated.

        Returns:
            (4, 4) motion of the last pose. None if the map is unchanged: too young, refined before, incomplete, or not
            fitting one of the frames.
        """
        window, atlas = self._young_map.complete_window(), self._atlas
        if not window or self._localize or atlas.current == atlas.saved or atlas.current in atlas.rebuildings:
            return None
        volume, Ts = atlas.volume, []
        time_sigma = self._color_motion.time_sigma(self._config.sensor.color_time_sigma)
        finest = len(self._config.tracker.widths) - 1
        for fused in window:
            level, velocity = fused.level, atlas.velocity_at(fused.frame.timestamp)
            color_weight = tracker.config.color_weight
            color_weight *= motion_discount(level, velocity, time_sigma, volume.voxel_size)
            weights = initial_weights([level], None, [fused.dynamic_mask])
            found = tracker.align(volume, [level], fused.T_world_camera, weights, finest, fused.exposure, color_weight)
            if not found.accepted:
                return None
            Ts.append(found.T_world_camera)
        before = np.stack([fused.T_world_camera for fused in window])
        after = before[0] @ se3.inverse(Ts[0]) @ np.stack(Ts)  # the first camera is the world
        volume.clear()
        for fused, T in zip(window, after, strict=True):
            frame = replace(fused.frame, color=exposed_color(fused.frame.rgb, fused.exposure))
            volume.integrate(frame, T, self._static(fused.dynamic_mask, frame.depth), WINDOW_STEP)
        stamps = np.array([fused.frame.timestamp for fused in window])
        corrections = after @ se3.inverse(before)
        atlas.move(stamps, corrections)
        self._redundancy.apply_correction(corrections[-1])
        return corrections[-1]

    def _static(self, dynamic_mask: NDArray[np.bool_], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Fused pixels: none within the margin of a dynamic measurement."""
        return ~grown_mask(dynamic_mask & (depth > 0), self._config.dynamics.margin_px * self._camera.width // 640)

    def integrate(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Fuse the static pixels of a frame, and store it for corrections."""
        observation = view.observation
        with view.timer("integrate"):
            static = self._static(dynamic_mask, observation.depth)
            observation = view.colored()
            frame = Frame(observation.timestamp, observation.depth, observation.rgb)
            recorded = observation.as_recorded
            self._atlas.integrate(frame, static, estimate.T_world_camera, estimate.exposure, recorded)
            self._redundancy.update(self._atlas.volume, view, estimate)
            self._young_map.fused(view, estimate, dynamic_mask)
