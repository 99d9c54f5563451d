"""The first frames of a map: their static world is decided when slow motion is visible.

The first frame is fused as a whole, the next ones without the motion between consecutive images. After UNDECIDED
seconds, ``YoungMap.decide`` compares them over longer times. If fused surface has moved, or poses followed a crowd, the
frames are registered and fused again (``Slam._replay``).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.dominant_motion import (
    AGREED,
    FEWEST,
    DominantMotion,
    exceeds_noise_share,
    propagate_to_segments,
    static_segments,
)
from dudmap.core.dynamics.image_motion import TrackedImage
from dudmap.core.dynamics.masks import full_size
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, is_majority_dynamic
from dudmap.core.geometry import se3
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate
from dudmap.core.verdict import Outcome, Verdict

SAME_POSE = 0.01, 0.25
"""Nearer poses (reference depths, deg) count as equal."""
UNDECIDED = 0.4, 0.8
"""Seconds after which slow motion is visible: crowds at 0.2 and 0.1 m/s have moved by 10 pixels at 2 m (262 px
focal)."""
FASTEST = 1.5
"""Walking speed, m/s."""
WINDOW, WINDOW_STEP = 30, 2
"""Fused frames after which the poses of a map are refined, and step between refined frames."""
MIN_READINGS = 0.02
"""Smallest share of pixels with static depth in a first frame."""


@dataclass(frozen=True, eq=False)
class StartFrame:
    """A fused frame of the first moments of a map.

    Attributes:
        view: The frame.
        estimate: Its provisional pose and labels.
        T_world_camera: (4, 4) pose by comparison of images; at first the provisional one.
        moving: (h, w) bool, label resolution, moving pixels; None if unknown.
        undecided: (h, w) bool, pixels not verified as static while most of the view moves; None for none.
    """

    view: FrameView
    estimate: PoseEstimate
    T_world_camera: NDArray[np.float64]
    moving: NDArray[np.bool_] | None = None
    undecided: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, view: FrameView, estimate: PoseEstimate) -> "StartFrame":
        """A frame with its pose and labels."""
        return cls(view, estimate, estimate.T_world_camera).registered(estimate)

    def registered(self, estimate: PoseEstimate) -> "StartFrame":
        """The frame with another pose and additional labels."""
        moving = self.moving
        if estimate.labels is not None:
            moving = _union(moving, estimate.labels.dynamic)
        return replace(self, estimate=estimate, T_world_camera=estimate.T_world_camera, moving=moving)

    @property
    def dynamic_mask(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that move or are declared dynamic."""
        mask, known = self._full_size(self.moving), self.view.known_dynamic
        return mask if known is None else mask | known

    @property
    def undecided_mask(self) -> NDArray[np.bool_]:
        """Pixels (H, W) that are undecided."""
        return self._full_size(self.undecided)

    def _full_size(self, low: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        depth = self.view.observation.depth
        return np.zeros(depth.shape, bool) if low is None else full_size(low, self.view.labelled.depth, depth)


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
        """The parts that the refinement needs."""
        observation, fine = view.colored(), view.pyramid.fine
        frame = Frame(observation.timestamp, observation.depth, observation.rgb)
        level = Level(fine.camera, fine.depth, fine.intensity)  # without the images it is made from
        return cls(frame, level, estimate.T_world_camera, estimate.exposure, dynamic_mask)


class YoungMap(Stateful):
    """The first frames of a map.

    Args:
        refines: Whether frames are kept for a second registration.
        decides: Whether frames are kept until their static world is decided.
        reference_depth: Reference depth of the sensor, metres.

    Attributes:
        textureless: Whether the first image carries no information; later ones are then not called blind.
    """

    textureless: Remembered[bool] = False
    _frames: Remembered[list[StartFrame]]
    _window: Remembered[list[FusedFrame]]
    _decisions: Remembered[int] = 0  # about slow motion
    _num_fused: Remembered[int] = 0
    _mostly: Remembered[bool] = False  # most of the view has moved in one of the first frames
    _shown: Remembered[bool] = False  # the labels of the first frames showed it at once
    _slow: Remembered[bool] = False  # the first frames are more than two
    _interval: Remembered[float] = 0.0  # mean time between them, seconds
    _collects: Remembered[bool] = False  # fused frames are kept for the second registration

    def __init__(self, *, refines: bool, decides: bool, reference_depth: float) -> None:
        self._refines, self._decides = refines, decides
        self._same_pose = SAME_POSE[0] * reference_depth, SAME_POSE[1]
        self._frames, self._window = [], []

    @staticmethod
    def verdict(view: FrameView, dynamic_mask: NDArray[np.bool_]) -> Verdict:
        """Whether a frame can start a map."""
        depth = view.observation.depth
        share = np.count_nonzero(depth[~dynamic_mask]) / depth.size
        sparse = "the depth image has hardly any measurements"
        return Verdict((Outcome.of("static_depth_share", share, MIN_READINGS, sparse, at_least=True),))

    def start(self, view: FrameView, estimate: PoseEstimate) -> None:
        """Record the frame that starts a map, before it is fused."""
        self._frames = [StartFrame.of(view, estimate)] if self._decides else []
        self._mostly, self._shown, self._decisions = False, False, 0
        self.restart_window()

    def restart_window(self) -> None:
        """Forget the frames for the second registration."""
        self._window, self._num_fused, self._collects = [], 0, self._refines

    @property
    def first(self) -> StartFrame | None:
        """The first frame; None if it is no longer kept."""
        return self._frames[0] if self._frames else None

    def recolored(self, view: FrameView) -> StartFrame:
        """The first frame, which must be kept, with other colours."""
        self._frames[0] = replace(self._frames[0], view=view)
        return self._frames[0]

    def fused(self, view: FrameView, estimate: PoseEstimate, dynamic_mask: NDArray[np.bool_]) -> None:
        """Record a fused frame."""
        if self._frames and view.timestamp > self._frames[-1].view.timestamp:
            self._frames.append(StartFrame.of(view, estimate))
        if not self._collects:
            return
        if self._num_fused % WINDOW_STEP == 0:
            self._window.append(FusedFrame.of(view, estimate, dynamic_mask))
        self._num_fused += 1

    def complete_window(self) -> list[FusedFrame]:
        """Every ``WINDOW_STEP``-th fused frame in order, after ``WINDOW`` fused frames, and forget them; empty
        before."""
        if self._num_fused < WINDOW or not self._window:
            return []
        window, self._window, self._collects = self._window, [], False
        return window

    def replace_frames(self, frames: list[StartFrame]) -> None:
        """Keep re-registered frames, unless the static world is decided."""
        if self._frames:
            self._frames = frames[::2] if self._slow else frames

    def decide(self, now: TrackedImage) -> list[StartFrame]:
        """Decide the static world of the first frames: fast motion with the second frame, slow motion after UNDECIDED.

        Backwards, hop by hop: find the oldest frame with a sure comparison (``_reference``); compare the frames after
        it, without pixels that move in between; continue from it.

        Args:
            now: The present image at its predicted pose, with its known moving pixels.

        Returns:
            The compared frames in order of time, relative to the oldest one, if a pose or a mask contradicts the map.
            Empty otherwise.
        """
        frames = self._frames
        if len(frames) > 1 and now.timestamp < frames[0].view.timestamp + UNDECIDED[self._decisions]:
            return []
        self._decisions += len(frames) > 1
        self._slow, self._interval = len(frames) > 1, (now.timestamp - frames[0].view.timestamp) / len(frames)
        if self._slow and self._interval > UNDECIDED[0] / 2:  # people are elsewhere in the next image
            self._frames = []
            return []
        if self._decisions == 1 and (last := frames[-1]).moving is not None:
            self._shown = is_majority_dynamic(last.moving, last.view.labelled)
        self._frames = [] if self._decisions == len(UNDECIDED) else frames[::2]
        rest, anchor, T_anchor, contradicted = frames, now, now.T_world_camera, False
        hops: list[tuple[TrackedImage, list[StartFrame], bool]] = []
        while rest and (reference := self._reference(anchor, rest)) is not None:
            first, motion = reference
            refuted = self._contradicts(motion, anchor, rest[first])
            contradicted |= refuted
            moving = _union(anchor.moving, propagate_to_segments(motion.before))
            self._mostly |= is_majority_dynamic(moving, anchor.pyramid.labelled)
            hops.insert(0, (replace(anchor, T_world_camera=T_anchor, moving=moving), rest[first:], refuted))
            if (found := self._compared(hops[0][0], rest[first], conservative=not refuted)) is None:
                break
            anchor = rest[first].view.tracked_at(rest[first].T_world_camera, moving=found.moving)
            rest, T_anchor = rest[:first], found.T_world_camera
        if not contradicted:
            return []
        pairs = [
            (frame, self._compared(anchor, frame, conservative=not refuted))
            for anchor, hop, refuted in hops
            for frame in hop  # slow motion is hidden between adjacent images; tracking goes on from the newest frame
            if frame is frames[-1] or not (self._slow and self._adjacent(anchor, frame))
        ]
        return self._revised([(before, after) for before, after in pairs if after is not None])

    def _reference(self, now: TrackedImage, frames: list[StartFrame]) -> tuple[int, DominantMotion] | None:
        """Number of the frame to compare with, and its motion; None if no comparison is sure.

        A sure comparison has most of the surface, and more corners than chance. The reference is the oldest sure one
        that most of the surface shares (AGREED), or that contradicts the map; else the oldest one.
        """
        sure = None
        for number, frame in enumerate(frames):
            motion = self._motion(now, frame, conservative=True)
            if motion is None or motion.share < 0.5 or np.count_nonzero(motion.before.static) < 2 * FEWEST:
                continue
            if motion.share >= AGREED or self._contradicts(motion, now, frame):
                return number, motion
            sure = sure or (number, motion)
        return sure

    def _motion(self, now: TrackedImage, frame: StartFrame, *, conservative: bool) -> DominantMotion | None:
        if frame.view.without_image:
            return None
        older = frame.view.tracked_at(frame.T_world_camera)
        return now.motion_to(older, consecutive=self._adjacent(now, frame), conservative=conservative)

    def _adjacent(self, now: TrackedImage, frame: StartFrame) -> bool:
        return now.timestamp - frame.view.timestamp < 1.5 * self._interval

    def _compared(self, now: TrackedImage, frame: StartFrame, *, conservative: bool) -> StartFrame | None:
        """An older frame as its comparison with an image shows it; None if unknown.

        ``conservative``: Only a clearly better pose replaces the expected one, which the reference confirmed.
        """
        motion = self._motion(now, frame, conservative=conservative)
        if motion is None:
            return None
        T = now.T_world_camera @ se3.inverse(motion.T_after_before)
        undecided = ~static_segments(motion.after) if self._mostly and self._slow and not self._shown else None
        return replace(frame, T_world_camera=T, moving=propagate_to_segments(motion.after), undecided=undecided)

    def _contradicts(self, motion: DominantMotion, now: TrackedImage, older: StartFrame) -> bool:
        T = now.T_world_camera @ se3.inverse(motion.T_after_before)
        moving = propagate_to_segments(motion.after)
        hidden = moving if older.moving is None else moving & ~older.moving
        agrees = se3.agree(T, older.T_world_camera, *self._same_pose)
        moved = hidden if agrees else moving  # without moving surface, depth and image disagree, by their calibration
        return exceeds_noise_share(moved, older.view.labelled)

    def _revised(self, compared: list[tuple[StartFrame, StartFrame]]) -> list[StartFrame]:
        """Compared frames in the world of the oldest one, with their earlier moving pixels if their poses agree.

        ``compared``: provisional and compared frames, in order of time.
        """
        if not compared:
            return []
        before, after = compared[0]
        T, out = before.T_world_camera @ se3.inverse(after.T_world_camera), []
        for before, after in compared:
            after = replace(after, T_world_camera=T @ after.T_world_camera)
            agrees = se3.agree(after.T_world_camera, before.T_world_camera, *self._same_pose)
            if agrees and before.moving is not None:
                after = replace(after, moving=_union(after.moving, before.moving))
            out.append(after)
        return out if _drags_smoothly(out) else []

    def abandon(self) -> None:
        """Forget the frames."""
        self._frames, self._window, self._collects = [], [], False


def _drags_smoothly(frames: list[StartFrame]) -> bool:
    """Whether people can have dragged the camera away from the revised poses, at most at FASTEST."""
    if len(frames) == 1:
        return True
    moved = [f.T_world_camera[:3, 3] - f.estimate.T_world_camera[:3, 3] for f in frames[1:]]
    elapsed = [f.view.timestamp - frames[0].view.timestamp for f in frames[1:]]
    speeds = (np.linalg.norm(moved, axis=1) / elapsed)[: max(len(moved) // 3, 1)]
    return bool(np.median(speeds) <= FASTEST)


def _union(a: NDArray[np.bool_] | None, b: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return b if a is None else a | b
