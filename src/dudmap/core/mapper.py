"""Mapping: fusion of frames with known poses. The first frames of a map are held back until slow motion is visible."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.dominant_motion import exceeds_noise_share
from dudmap.core.dynamics.masks import full_size, grown_mask
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, exposed_color, reduced
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.redundancy import RedundantViews
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.color_motion import ColorMotion, motion_discount
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate, StageTimer, initial_weights
from dudmap.core.tracking.pose_prediction import PosePrediction, PosePredictor
from dudmap.core.tracking.tracker import Tracker
from dudmap.core.verdict import Outcome, Verdict

WINDOW, WINDOW_STEP = 30, 2
"""Number of fused frames after which the poses of a new map are refined, and step between the refined frames."""
MIN_READINGS = 0.02
"""Smallest share of pixels with static depth in a first frame."""


@dataclass(frozen=True, eq=False)
class StartFrame:
    """A frame of the first moments of a map.

    Attributes:
        view: The frame.
        estimate: Its pose and labels.
        dynamic_mask: (H, W) bool, pixels that are not fused.
        fused: Whether it is part of the map.
    """

    view: FrameView
    estimate: PoseEstimate
    dynamic_mask: NDArray[np.bool_]
    fused: bool


@dataclass(frozen=True, eq=False)
class FusedFrame:
    """A fused frame whose pose is refined later.

    Attributes:
        frame: Depth and colour.
        level: Finest level of the registration.
        T_world_camera: (4, 4).
        exposure: Gain and offset from its colours to the map's.
        dynamic_mask: (H, W) bool, pixels that were not fused.
    """

    frame: Frame
    level: Level
    T_world_camera: NDArray[np.float64]
    exposure: tuple[float, float]
    dynamic_mask: NDArray[np.bool_]

    @classmethod
    def of(cls, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> "FusedFrame":
        """The parts of a frame that the refinement needs."""
        observation, fine = view.colored(), view.pyramid.fine
        frame = Frame(observation.timestamp, observation.depth, observation.rgb)
        level = Level(fine.camera, fine.depth, fine.intensity)  # without the images it is made from
        return cls(frame, level, estimate.T_world_camera, estimate.exposure, dynamic_mask)


class Bootstrap(Stateful):
    """The first frames of a map, parts of which must be removed again.

    A single image shows no motion. So all pixels of the first frame count as static unless the caller declares them
    dynamic, and slow motion appears only later. When motion appears, its pixels are removed from the first frame, and
    the map is rebuilt from this frame. Later frames are held back until slow motion is visible, and are then fused
    without their moving pixels.

    The first frames were registered to an incomplete map. They are kept to be registered again.

    Args:
        refines: Whether the first frames are kept for a second registration.
        second_pass: The map of the first pass shows motion: frames are held back only until the stream ends.

    Attributes:
        textureless: Whether the image of the first frame carries no information; later ones are then not called blind.
    """

    textureless: Remembered[bool] = False
    _frames: Remembered[list[StartFrame]]
    _window: Remembered[list[FusedFrame]]
    _num_fused: Remembered[int] = 0

    def __init__(self, *, refines: bool, second_pass: bool = False) -> None:
        self._refines, self._second_pass = refines, second_pass
        self._frames = []
        self._window = []

    @staticmethod
    def verdict(view: FrameView, dynamic_mask: NDArray[np.bool_]) -> Verdict:
        """Whether a frame can start a map."""
        depth = view.observation.depth
        share = np.count_nonzero(depth[~dynamic_mask]) / depth.size
        sparse = "the depth image has hardly any measurements"
        return Verdict((Outcome.of("static_depth_share", share, MIN_READINGS, sparse, at_least=True),))

    def start(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Record the frame that starts a map."""
        self._frames, self._num_fused = [StartFrame(view, estimate, dynamic_mask, fused=True)], 1
        self._window = [FusedFrame.of(view, estimate, dynamic_mask)] if self._refines else []

    def fused(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Record a fused frame, or the first frame of a map that is rebuilt."""
        if not self._window:
            return
        if view.timestamp <= self._window[0].frame.timestamp:
            self._window, self._num_fused = [], 0
        if self._num_fused % WINDOW_STEP == 0:
            self._window.append(FusedFrame.of(view, estimate, dynamic_mask))
        self._num_fused += 1

    def complete_window(self) -> list[FusedFrame]:
        """Every ``WINDOW_STEP``-th fused frame, in order of time, after ``WINDOW`` fused frames, and forget them; empty
        before."""
        if not self._window or self._num_fused < WINDOW:
            return []
        window, self._window = self._window, []
        return sorted(window, key=lambda fused: fused.frame.timestamp)

    def add(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_], *, fused: bool) -> None:
        """Record another frame of the first moments."""
        if self._frames or self._second_pass:
            self._frames.append(StartFrame(view, estimate, dynamic_mask, fused))

    @property
    def first(self) -> FrameView | None:
        """The first frame; None if it is no longer kept."""
        return self._frames[0].view if self._frames and not self._second_pass else None

    def recolored(self, view: FrameView) -> StartFrame:
        """The first frame, which must be kept, with other colours."""
        self._frames[0] = replace(self._frames[0], view=view)
        return self._frames[0]

    def revised(self, moving_before: NDArray[np.bool_] | None) -> StartFrame | None:
        """The first frame with its moving pixels added to the mask; None if the map has none of them.

        The later frames then count as not fused, because the map is rebuilt.

        Args:
            moving_before: (h, w) bool, label resolution, pixels of the first image that move in a later image; None if
                unknown.
        """
        if self.first is None or moving_before is None:
            return None
        first = self._frames[0]
        labelled = first.view.labelled
        if not exceeds_noise_share(moving_before & ~reduced(first.dynamic_mask, labelled), labelled):
            return None
        moving = full_size(moving_before, labelled.depth, first.view.observation.depth)
        first = replace(first, dynamic_mask=first.dynamic_mask | moving)
        self._frames = [first, *(replace(frame, fused=False) for frame in self._frames[1:])]
        return first

    def released(self, *, ended: bool = False) -> list[StartFrame]:
        """The held-back frames without the pixels that have moved since; releases them.

        A frame without a common motion with the last one is dropped. So is depth without colour, which cannot be
        compared, unless the stream has ``ended`` and no later frame replaces it.
        """
        if self._second_pass and not ended:
            self._frames = []
        if not self._frames:
            return []
        last, frames = self._frames[-1], [frame for frame in self._frames[:-1] if not frame.fused]
        now = last.view.tracked_at(last.estimate.T_world_camera)
        interval = (now.timestamp - self._frames[0].view.timestamp) / max(len(self._frames) - 1, 1)
        self._frames = []
        out = []
        for frame in frames:
            if ended and frame.view.without_image:
                out.append(frame)
                continue
            older = frame.view.tracked_at(frame.estimate.T_world_camera)
            motion = older.motion_to(now, (now.timestamp - older.timestamp) / interval)
            if motion is not None and older.moving is not None:
                moving = full_size(older.moving, frame.view.labelled.depth, frame.view.observation.depth)
                out.append(replace(frame, dynamic_mask=frame.dynamic_mask | moving))
        return out if last.fused else [*out, last]

    def abandon(self) -> None:
        """Forget the frames, because the camera is tracked in another map."""
        self._frames, self._window = [], []


class Mapper:
    """Fuses frames into the current map of the atlas.

    Args:
        config: All parameters.
        camera: Camera of the frames, without lens distortion.
        atlas: The maps.
        bootstrap: The first frames of the current map.
        predictor: Decides how long slow motion is hidden.
        color_motion: Registers colours by the velocity of the camera.
        redundancy: Records the fused views.
        localize: Frames are neither fused nor made keyframes.
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

    def revise_first_frame(self, view: FrameView, prediction: PosePrediction) -> None:
        """Rebuild the map from the first frame without pixels that move in a later image. Once slow motion is visible,
        fuse the held-back frames."""
        self._begin_anew(self._bootstrap.revised(prediction.moving_before), view)
        if not self._predictor.ego_motion.slow_motion_is_hidden(view.timestamp):
            self._fuse_held(self._bootstrap.released(), view.timer)

    def finish(self) -> int:
        """Fuse the held-back frames at the end of the stream; returns their number."""
        return self._fuse_held(self._bootstrap.released(ended=True), StageTimer())

    def _fuse_held(self, frames: list[StartFrame], timer: StageTimer) -> int:
        for frame in frames:
            self.integrate(replace(frame.view, timer=timer), frame.estimate, frame.dynamic_mask)
        return len(frames)

    def recolor_first_frame(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Rebuild the map of the first frame with colours registered by the velocity to the second frame."""
        first = self._color_motion.first_frame(self._bootstrap.first, view.timestamp, estimate.T_world_camera)
        self._begin_anew(None if first is None else self._bootstrap.recolored(first), view)

    def _begin_anew(self, first: StartFrame | None, view: FrameView) -> None:
        """Empty the map and fuse its first frame again; None changes nothing."""
        if first is not None:
            self._atlas.clear_map()
            self.integrate(replace(first.view, timer=view.timer), first.estimate, first.dynamic_mask)

    def extend(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_], *, fuse: bool) -> None:
        """Fuse a frame, and keep it for relocalization if no keyframe is near."""
        if fuse:
            self.integrate(view, estimate, dynamic_mask)
        if self._config.relocalization.enabled and not view.without_image:
            with view.timer("keyframe"):
                keyframes = self._atlas.keyframes
                place = view.colored(), estimate.T_world_camera, dynamic_mask, self._atlas.current
                keyframes.remember(*place)
                if not self._localize:
                    keyframes.add(*place)
        if self._predictor.ego_motion.slow_motion_is_hidden(view.timestamp) and not view.blind:
            self._bootstrap.add(view, estimate, dynamic_mask, fused=fuse)

    def refine_first_poses(self, tracker: Tracker) -> NDArray[np.float64] | None:
        """Register the first frames of a map again to the more complete map, and rebuild it from them.

        The first frames were registered to a map of few frames and followed its noise. In the later map each frame has
        little weight, so that its own noise does not bind it. Poses between the refined frames are interpolated.

        Args:
            tracker: Registers frames.

        Returns:
            (4, 4) motion of the last pose. None if the map is unchanged: it is too young, was refined before, is
            incomplete, or does not fit one of the frames.
        """
        window, atlas = self._bootstrap.complete_window(), self._atlas
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
        """Pixels (H, W) that are fused: none within the margin of a dynamic measurement."""
        return ~grown_mask(dynamic_mask & (depth > 0), self._config.dynamics.margin_px * self._camera.width // 640)

    def integrate(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Fuse the static pixels of a frame, in the exposure of the map, and store it for corrections."""
        observation = view.observation
        with view.timer("integrate"):
            static = self._static(dynamic_mask, observation.depth)
            if self._predictor.mostly_slow and estimate.unverified_mask is not None:
                static &= ~full_size(estimate.unverified_mask, view.labelled.depth, observation.depth)
            observation = view.colored()
            frame = Frame(observation.timestamp, observation.depth, observation.rgb)
            recorded = observation.as_recorded
            self._atlas.integrate(frame, static, estimate.T_world_camera, estimate.exposure, recorded)
            self._redundancy.update(self._atlas.volume, view, estimate)
            self._bootstrap.fused(view, estimate, dynamic_mask)
