"""Where the registration of a frame starts, and what moves in it as far as the last image and this one tell."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.dynamics.ego_motion import DominantMotion, EgoMotionSegmenter, exceeds_noise_share
from dudmap.frames.observation import Level
from dudmap.frames.pyramid import Pyramid, is_majority_dynamic
from dudmap.geometry import se3
from dudmap.mapping.volume import FREE, UNKNOWN, TsdfVolume
from dudmap.stage_timer import StageTimer
from dudmap.tracking.front_end import FrontEnd

CLEARLY = 0.95
"""A pose explains an image clearly better than another if its cost is below this share of the other's."""


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """What is expected of a frame.

    Attributes:
        T_world_camera: (4, 4).
        moving: (h, w) bool, what moves in it; None where it was not looked for.
        moving_before: (h, w) bool, what moves in the first image of a map that was made of it alone; else None.
    """

    T_world_camera: NDArray[np.float64]
    moving: NDArray[np.bool_] | None = None
    moving_before: NDArray[np.bool_] | None = None


class PosePredictor:
    """Expects that the camera goes on as it did, and while the map is young, or movers hide most of the view, looks.

    Args:
        config: All parameters.
        registration: Knows the camera's velocity and what moved in the last frame.
        seen: Poses (4, 4) by timestamp, where they are known from a first pass.

    Attributes:
        parallax: Compares images.
        unverified_mask: (h, w) bool, what nothing shows to rest, while a crowd moves; else None.
    """

    def __init__(
        self, config: Config, registration: FrontEnd, seen: Mapping[float, NDArray[np.float64]] | None = None
    ) -> None:
        self.registration = registration
        self.parallax = EgoMotionSegmenter(config.dynamics.start_seconds if config.dynamics.method == "em" else 0.0)
        self.unverified_mask: NDArray[np.bool_] | None = None
        self._seen = seen or {}
        self._alone = False  # the map was made of one image, and nothing has shown what moves in it
        self._crowd = False  # most of the view has moved from the first frame on

    def begin(self, timestamp: float) -> None:
        """The map has been made of a first frame."""
        self.parallax.start(timestamp)
        self._alone = self._crowd = True

    def predict(self, timestamp: float, pyramid: Pyramid, volume: TsdfVolume, clock: StageTimer) -> PosePrediction:
        """First guess for a frame that is to be registered to a map."""
        if self._seen and not self.parallax.started:  # a second pass
            self.parallax.start(timestamp)
        T_expected = self._seen.get(timestamp, self.registration.motion.predict(timestamp))
        self.unverified_mask = None
        if not self.parallax.active:
            return PosePrediction(T_expected)
        with clock("parallax"):
            seen = self.see(timestamp, pyramid, volume)
            if seen is None:
                return PosePrediction(T_expected)
            motion, T_seen = seen
            moving_before = motion.moving_before if self._alone else None
            if timestamp in self._seen:
                T_seen = T_expected
            elif not self._alone and self.fits_better(volume, T_expected, T_seen, pyramid.coarse):
                return PosePrediction(T_expected)  # what most corners follow is not the static world
            self._alone = False
            moving, small = motion.moving_after, pyramid.labelled
            if not exceeds_noise_share(moving, small):  # else something slow hardly drags the camera on its own
                surface = self.registration.detector.pieces(small, volume)
                moving = moving | self.parallax.slow(timestamp, T_seen, pyramid, surface)
            self._crowd = self._crowd and self.parallax.young(timestamp) and is_majority_dynamic(moving, small)
            if self._crowd:
                self.unverified_mask = ~motion.resting_after
            if not self.parallax.young(timestamp):  # elsewhere the map knows better what moves
                moving = moving & (_place(volume, small, T_seen) == UNKNOWN)
            return PosePrediction(T_seen, moving, moving_before)

    def see(
        self, timestamp: float, pyramid: Pyramid, volume: TsdfVolume
    ) -> tuple[DominantMotion, NDArray[np.float64]] | None:
        """The static world's motion from the last image to this one, and the pose (4, 4) it leads to, if known."""
        surface = self.registration.detector.pieces(pyramid.labelled, volume)
        model = self.registration.motion
        T_expected = se3.inverse(model.predict(timestamp)) @ model.T_world_camera
        motion = self.parallax.compare(timestamp, pyramid, surface, T_expected)
        return None if motion is None else (motion, model.T_world_camera @ se3.inverse(motion.T_after_before))

    def keep(self, timestamp: float, pyramid: Pyramid, T_world_camera: NDArray[np.float64], volume: TsdfVolume) -> None:
        """Take over a tracked frame as the one to compare the next with."""
        if self.parallax.seconds > 0:
            surface, moved = self.registration.detector.pieces(pyramid.labelled, volume), self.registration.moved
            self.parallax.remember(timestamp, T_world_camera, pyramid, surface, moved)

    def fits_better(
        self, volume: TsdfVolume, T: NDArray[np.float64], T_other: NDArray[np.float64], level: Level
    ) -> bool:
        """Whether a pose explains an image clearly better than another one, apart from what has just moved."""
        weights = self.registration.expected([level]) or [np.ones_like(level.depth)]
        static = np.where(_place(volume, level, T) == FREE, np.float32(0), weights[0])
        tracker = self.registration.tracker
        cost, other = (tracker.linearize(volume, level, pose, static).cost for pose in (T, T_other))
        return cost < CLEARLY * other


def _place(volume: TsdfVolume, level: Level, T_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    """What a map knows of the points of an image (h, w): SURFACE, FREE or UNKNOWN."""
    volume.look_at(T_world_camera)
    return volume.sample(level.depth, level.intensity, level.camera, T_world_camera).occupancy
