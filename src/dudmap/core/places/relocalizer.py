"""Relocalization of a lost frame by recognised keyframes, and the start of new submaps."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.dominant_motion import AGREED, dominant_motion
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Pyramid, is_majority_dynamic
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.place_recognition import MIN_INLIERS
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import Outcome, Verdict
from dudmap.core.young_map import UNDECIDED

MIN_READINGS = 0.2
"""Smallest share of depth pixels in the first frame of a submap."""
Register = Callable[[TsdfVolume, NDArray[np.float64]], PoseEstimate]
"""Registers and labels the lost frame against a map, from a pose (4, 4) in its world."""


@dataclass(frozen=True, eq=False)
class Relocalization:
    """Verified pose and labels of a lost frame in the recognised submap."""

    estimate: PoseEstimate
    submap: int
    verdict: Verdict


class Relocalizer(Stateful):
    """Recovers the camera pose after tracking was lost.

    A lost frame is compared with the last tracked frame and all keyframes; registration verifies each candidate. The
    atlas is not changed.
    """

    _lost_since: Remembered[float | None] = None
    _mostly_dynamic: Remembered[bool] = False  # most of the view moved in the last tracked frame
    # time, images and segments of the lost frames of the last UNDECIDED seconds
    _recent: Remembered[deque[tuple[float, Pyramid, Segmentation]]]
    _place_unknown: Remembered[bool] = False
    _counted: Remembered[tuple[float, int]]

    def __init__(self, config: Config, atlas: Atlas, prior_map: TsdfVolume | None = None) -> None:
        self.config = config
        self.atlas = atlas
        self.prior_map = prior_map
        self._recent = deque()
        self._counted = -np.inf, 0  # time and number of features of the last frame with extracted features

    @property
    def is_lost(self) -> bool:
        """Whether no frame was tracked since ``lost``."""
        return self._lost_since is not None

    def start_in_saved_map(self) -> None:
        """Declare the camera's place unknown until a frame is recognised."""
        self._place_unknown = True

    @property
    def verdict(self) -> Verdict:
        """Whether to trust a registration from a predicted pose."""
        reason = "the camera has not been recognised in the saved map yet"
        return Verdict((Outcome("place_unknown", 1, 0, reason),) if self._place_unknown else ())

    def lost(self, timestamp: float, *, mostly_dynamic: bool = False) -> None:
        """Record a lost frame; ``mostly_dynamic``: most of the view moved in the last tracked frame."""
        if self._lost_since is None:
            self._lost_since, self._mostly_dynamic = timestamp, mostly_dynamic

    def found(self) -> None:
        """Record that the camera is tracked, or a new submap started."""
        self._lost_since, self._mostly_dynamic, self._place_unknown = None, False, False
        self._recent.clear()

    def recover(
        self, view: FrameView, register: Register, judge: Callable[[TrackingResult], Verdict]
    ) -> Relocalization | None:
        """Verified pose of a lost frame; None if no candidate passes.

        Candidates in the current submap come first: the last tracked frame, then most feature matches. The first that
        its registration confirms and ``judge`` accepts is the result.
        """
        if not (self.config.relocalization.enabled and view.observation.has_color):
            return None
        with view.timer("recognise"):
            keyframes = self.atlas.keyframes
            features = keyframes.extract(view.colored(), view.known_dynamic)
            self._counted = view.observation.timestamp, len(features)
            candidates = keyframes.recognise(features)
        candidates = [candidate for candidate in candidates if candidate.keyframe.submap in self.atlas.volumes]
        candidates.sort(key=lambda candidate: candidate.keyframe.submap != self.atlas.current)  # a stable sort
        num_readings = max(np.count_nonzero(view.labelled.depth), 1)
        for candidate in candidates:
            submap, T_features = candidate.keyframe.submap, candidate.T_world_camera
            prior = self.prior_map
            volume = self.atlas.volume_around(submap, T_features) if prior is None else prior
            estimate = register(volume, T_features)
            tracking, labels = estimate.tracking, estimate.labels
            static_share = 1.0 if labels is None else 1 - np.count_nonzero(labels.dynamic) / num_readings
            verdict = candidate.verdict(tracking, self.atlas.unit, static_share) + judge(tracking)
            if verdict.accepted:
                return Relocalization(estimate, submap, verdict)
        return None

    @property
    def may_start_submaps(self) -> bool:
        """Whether a map may be discarded for an empty one."""
        return self.config.submaps.enabled and self.atlas.history is not None

    def start_verdict(self, view: FrameView) -> Verdict:
        """Whether to start an empty submap with this lost frame. Conditions:

        * The camera has been lost for ``submaps.patience`` seconds.
        * The frame has enough depth for a map and, if it has colour, enough features for a keyframe.
        * The image motion is camera motion (``_shows_static_world``), by the last lost image (fast people) and one
          UNDECIDED older (slow people).
        """
        return Verdict.of(self._start_outcomes(view))

    def _start_outcomes(self, view: FrameView) -> Iterator[Outcome]:
        observation, since = view.observation, self._lost_since
        possible = self.may_start_submaps and since is not None
        yield Outcome.of("may_start", possible, 1, "no other map may be started", at_least=True)
        assert since is not None
        while len(self._recent) > 1 and observation.timestamp - self._recent[0][0] > UNDECIDED[0]:
            self._recent.popleft()
        recent = [(pyramid, segmentation) for _, pyramid, segmentation in self._recent]
        if self._compares_images:
            self._recent.append((view.timestamp, view.pyramid, view.segmentation()))
        lost, patience = observation.timestamp - since, self.config.submaps.patience
        yield Outcome.of("lost_s", lost, patience, "the camera is lost for {figure:.1f} s", at_least=True)
        share, sparse = np.count_nonzero(observation.depth) / observation.depth.size, "only {figure:.0%} of the depth"
        yield Outcome.of("depth_share", share, MIN_READINGS, sparse, at_least=True)
        timestamp, count = self._counted
        if timestamp != observation.timestamp and observation.has_color:  # relocalization is off
            count = len(self.atlas.keyframes.extract(observation))
        if observation.has_color:
            yield Outcome.of("features", count, MIN_INLIERS, "only {figure:.0f} features", at_least=True)
        for before in [recent[-1], recent[0]] if len(recent) > 1 else recent or [None]:
            static = self._shows_static_world(before, view)
            yield Outcome.of("static_world", static, 1, "the motion may not be the camera's", at_least=True)

    @property
    def _compares_images(self) -> bool:
        return self.config.dynamics.enabled and self.config.dynamics.start_seconds > 0

    def _shows_static_world(self, before: tuple[Pyramid, Segmentation] | None, view: FrameView) -> bool:
        """Whether the motion since an earlier lost image is certainly the camera's.

        A near crowd may fill most pixels. One motion must explain AGREED of the surface and most of the pixels.
        Exceptions:

        * No common motion (no texture): True unless most of the view moved when the camera was lost.
        * Images are not compared (``dynamics.start_seconds`` = 0): True.
        """
        if not self._compares_images:
            return True
        motion = None
        if before is not None:
            motion = dominant_motion(before[0], view.pyramid, (before[1], view.segmentation()))
        if motion is None:
            return not self._mostly_dynamic
        return motion.share >= AGREED and not is_majority_dynamic(motion.moving_after, view.labelled)
