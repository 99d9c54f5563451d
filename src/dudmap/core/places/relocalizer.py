"""Relocalization: the pose of a lost frame from recognised keyframes, and the decision to start a new submap."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.dominant_motion import AGREED, dominant_motion
from dudmap.core.dynamics.ego_motion import LONGEST_BASELINE
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Pyramid, is_majority_dynamic
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.atlas import Atlas
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.frame_view import FrameView, PoseEstimate
from dudmap.core.tracking.tracker import TrackingResult

Register = Callable[[TsdfVolume, NDArray[np.float64]], PoseEstimate]
"""Registers and labels the lost frame against a map, starting from a pose (4, 4) in the world of that map."""


@dataclass(frozen=True, eq=False)
class Relocalization:
    """Verified pose and labels of a frame after tracking was lost, in the map of the submap that it was recognised in,
    which may differ from the current one."""

    estimate: PoseEstimate
    submap: int


class Relocalizer(Stateful):
    """Recovers the camera pose after tracking was lost.

    A lost frame is compared with the last tracked one and with all keyframes of the atlas. Each candidate pose is
    verified by registering the frame against the map of the candidate's submap. The atlas is not changed: the caller
    switches to the submap of the frame or starts a new submap.

    """

    _lost_since: Remembered[float | None] = None
    _mostly_dynamic: Remembered[bool] = False  # most of the view moved in the last tracked frame
    # time, images and segments of the last lost frames, those of LONGEST_BASELINE
    _recent: Remembered[deque[tuple[float, Pyramid, Segmentation]]]
    _place_unknown: Remembered[bool] = False
    _counted: Remembered[tuple[float, int]]

    def __init__(self, config: Config, atlas: Atlas, prior_map: TsdfVolume | None = None) -> None:
        self.config = config
        self.atlas = atlas
        self.prior_map = prior_map
        self._recent = deque()
        self._counted = -np.inf, 0  # time of the last frame that was to be recognised, and its features

    @property
    def is_lost(self) -> bool:
        """Whether no frame has been tracked since the last call of ``lost``."""
        return self._lost_since is not None

    def start_in_saved_map(self) -> None:
        """Declare the camera's place in the current map unknown until a frame is recognised."""
        self._place_unknown = True

    @property
    def reason(self) -> str:
        """Reason why no registration from a predicted pose can be trusted, empty if one can."""
        return "the camera has not been recognised in the saved map yet" if self._place_unknown else ""

    def lost(self, timestamp: float, *, mostly_dynamic: bool = False) -> None:
        """Record a frame (timestamp in seconds) that was neither tracked nor relocalized, and whether most of the view
        moved in the last tracked one."""
        if self._lost_since is None:
            self._lost_since, self._mostly_dynamic = timestamp, mostly_dynamic

    def found(self) -> None:
        """Record that the camera is tracked again or that a new submap was started."""
        self._lost_since, self._mostly_dynamic, self._place_unknown = None, False, False
        self._recent.clear()

    def recover(
        self, view: FrameView, register: Register, accept: Callable[[TrackingResult], bool]
    ) -> Relocalization | None:
        """Pose of a lost frame, verified by the registration against the map; None if no candidate passes.

        Candidates in the current submap are tried first: the pose by the last tracked frame, then poses in the order of
        their matching features. The result is the first pose whose registration confirms it and is accepted. The view's
        timer receives the time of feature matching as stage ``recognise``.
        """
        limits = self.config.relocalization
        if not limits.enabled:
            return None
        if not view.observation.has_color:
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
            if candidate.is_confirmed(tracking, limits, static_share) and accept(tracking):
                return Relocalization(estimate, submap)
        return None

    @property
    def may_start_submaps(self) -> bool:
        """Whether a map may be given up for a new, empty one."""
        return self.config.submaps.enabled and self.atlas.history is not None

    def wants_new_submap(self, view: FrameView) -> bool:
        """Whether tracking should go on in a new, empty submap that starts with this lost frame.

        Three conditions must hold. The camera has been lost for ``submaps.patience`` seconds. The frame has enough
        depth for a map and, if it has colour, enough features for a keyframe. It does not show people
        (``_shows_static_world``). Comparison with the last lost image finds fast people; comparison with an image
        LONGEST_BASELINE older finds slow ones.
        """
        config, observation = self.config.submaps, view.observation
        if not self.may_start_submaps or self._lost_since is None:
            return False
        while len(self._recent) > 1 and observation.timestamp - self._recent[0][0] > LONGEST_BASELINE:
            self._recent.popleft()
        recent = [(pyramid, segmentation) for _, pyramid, segmentation in self._recent]
        if self._compares_images:
            self._recent.append((view.timestamp, view.pyramid, view.segmentation()))
        if observation.timestamp - self._lost_since < config.patience:
            return False
        if np.count_nonzero(observation.depth) < config.min_readings * observation.depth.size:
            return False
        timestamp, count = self._counted
        if timestamp != observation.timestamp and observation.has_color:  # relocalisation is off
            count = len(self.atlas.keyframes.extract(observation))
        if observation.has_color and count < self.config.relocalization.min_inliers:
            return False
        if len(recent) < 2:
            return self._shows_static_world(recent[0] if recent else None, view)
        return self._shows_static_world(recent[-1], view) and self._shows_static_world(recent[0], view)

    @property
    def _compares_images(self) -> bool:
        return self.config.dynamics.method == "em" and self.config.dynamics.start_seconds > 0

    def _shows_static_world(self, before: tuple[Pyramid, Segmentation] | None, view: FrameView) -> bool:
        """Whether the motion from an earlier lost image to this one is certainly that of the camera.

        Two images do not tell which of two motions is the camera's. A crowd may fill most of the pixels, since it is
        near; the static world may fill most of the surface, since it is far. A map is only begun where one motion does
        both: at least AGREED of the surface and most of the pixels follow it. Without a common motion, as in images
        without texture, it is begun unless most of the view moved when the camera was lost. Nothing is examined where
        images are not compared (``dynamics.start_seconds`` = 0).
        """
        if not self._compares_images:
            return True
        motion = None
        if before is not None:
            motion = dominant_motion(before[0], view.pyramid, (before[1], view.segmentation()))
        if motion is None:
            return not self._mostly_dynamic
        return motion.share >= AGREED and not is_majority_dynamic(motion.moving_after, view.labelled)
