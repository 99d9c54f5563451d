"""Mapping: frames whose pose is known become part of the map, and its first moments are corrected."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.bootstrap import WINDOW_STEP, Bootstrap, StartFrame
from dudmap.core.dynamics.masks import full_size, grown_mask
from dudmap.core.frames.exposure import exposed_color
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.redundancy import RedundantViews
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.color_noise import motion_discount
from dudmap.core.tracking.estimate import PoseEstimate, initial_weights
from dudmap.core.tracking.frame_view import FrameView
from dudmap.core.tracking.pose_prediction import PosePrediction, PosePredictor
from dudmap.core.tracking.tracker import Tracker


class Mapper:
    """Fuses frames into the current map of the atlas.

    Args:
        config: All parameters.
        camera: Of the frames, without lens distortion.
        atlas: The maps.
        bootstrap: The first frames of the current map.
        predictor: Knows for how long slow motion cannot be seen yet.
        color_motion: Colours moved by the velocity of the camera.
        redundancy: Is told which views the map holds.
        localize: Frames that are not fused do not become keyframes either.
    """

    def __init__(
        self,
        config: Config,
        camera: Camera,
        atlas: Atlas,
        bootstrap: Bootstrap,
        predictor: PosePredictor,
        color_motion: ColorMotion,
        redundancy: RedundantViews,
        *,
        localize: bool,
    ) -> None:
        self._config, self._camera, self._atlas, self._bootstrap = config, camera, atlas, bootstrap
        self._predictor, self._color_motion, self._redundancy = predictor, color_motion, redundancy
        self._localize = localize

    def revise_start(self, view: FrameView, prediction: PosePrediction) -> None:
        """Make the map anew of the first frame without what a later image shows to have moved in it; once slow motion
        can be seen, fuse the frames that were held back until then."""
        self._begin_anew(self._bootstrap.revised(prediction.moving_before), view)
        if not self._predictor.ego_motion.slow_motion_is_hidden(view.timestamp):
            for frame in self._bootstrap.released():
                self.integrate(replace(frame.view, timer=view.timer), frame.estimate, frame.dynamic_mask)

    def recolor_first_frame(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Make the map of the first frame anew with its colours moved by the velocity that the second one shows."""
        first = self._color_motion.first_frame(view.timestamp, estimate.T_world_camera)
        self._begin_anew(None if first is None else self._bootstrap.recolored(first), view)

    def _begin_anew(self, first: StartFrame | None, view: FrameView) -> None:
        """Empty the map and fuse its first frame again; None leaves it as it is."""
        if first is not None:
            self._atlas.clear_map()
            self.integrate(replace(first.view, timer=view.timer), first.estimate, first.dynamic_mask)

    def extend(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_], *, fuse: bool) -> None:
        """Fuse a frame, and keep it for relocalization if the camera has been nowhere near."""
        if self._config.relocalization.enabled and not (view.blind or self._localize):
            with view.timer("keyframe"):
                T_world_camera = estimate.T_world_camera
                self._atlas.keyframes.add(view.observation, T_world_camera, ~dynamic_mask, self._atlas.current)
        if fuse:
            self.integrate(view, estimate, dynamic_mask)
        if self._predictor.ego_motion.slow_motion_is_hidden(view.timestamp):
            self._bootstrap.add(view, estimate, dynamic_mask, fused=fuse)

    def refine_start(self, tracker: Tracker) -> NDArray[np.float64] | None:
        """Once the map has seen enough, register the frames of its first moments again and make it anew of them.

        The first frames were registered to a map of few others, whose noise they followed. In the map of all of them
        each counts little, so that its own noise does not hold it where it was. Frames between those that are
        remembered follow their neighbours.

        Args:
            tracker: Registers frames.

        Returns:
            (4, 4) motion of the last pose; None where the map stays as it is: it is too young, was refined before, does
            not hold all its frames, or one of them does not fit it.
        """
        window, atlas = self._bootstrap.complete_window(), self._atlas
        if not window or self._localize or atlas.current == atlas.saved or atlas.current in atlas.rebuildings:
            return None
        volume, Ts, time_sigma = atlas.volume, [], self._config.sensor.color_time_sigma
        for view, estimate, mask in ((frame.view, frame.estimate, frame.dynamic_mask) for frame in window):
            level, T_world_camera = view.pyramid.fine, estimate.T_world_camera
            discount = motion_discount(level, atlas.velocity_at(view.timestamp), time_sigma, volume.voxel_size)
            found = tracker.align(
                volume, [level], T_world_camera, initial_weights([level], None, [mask]), len(view.pyramid.tracked) - 1,
                estimate.exposure, tracker.config.color_weight * discount,
            )  # fmt: skip
            if not found.converged:
                return None
            Ts.append(found.T_world_camera)
        before = np.stack([frame.estimate.T_world_camera for frame in window])
        after = before[0] @ se3.inverse(Ts[0]) @ np.stack(Ts)  # the first camera is the world
        atlas.make_room()
        new = atlas.make_volume()
        for frame, T in zip(window, after, strict=True):
            observation = frame.view.observation
            color = exposed_color(observation.rgb, frame.estimate.exposure)
            again = Frame(observation.timestamp, observation.depth, color)
            new.integrate(again, T, self._static(frame.dynamic_mask), WINDOW_STEP)
        stamps = np.array([frame.view.timestamp for frame in window])
        corrections = after @ se3.inverse(before)
        atlas.move(stamps, corrections, new)
        self._redundancy.apply_correction(corrections[-1])
        return corrections[-1]

    def _static(self, dynamic_mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Pixels (H, W) that are fused."""
        return ~grown_mask(dynamic_mask, self._config.dynamics.margin_px * self._camera.width // 640)

    def integrate(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Fuse the static pixels of a frame, in the exposure of the map, and keep it for later corrections."""
        observation = view.observation
        with view.timer("integrate"):
            static = self._static(dynamic_mask)
            if self._predictor.slow_crowd and estimate.unverified_mask is not None:
                static &= ~full_size(estimate.unverified_mask, view.labelled.depth, observation.depth)
            frame = Frame(observation.timestamp, observation.depth, observation.rgb)
            recorded = observation.as_recorded
            self._atlas.integrate(frame, static, estimate.T_world_camera, estimate.exposure, recorded)
            self._redundancy.update(self._atlas.volume, view, estimate)
            self._bootstrap.fused(view, estimate, dynamic_mask)
