"""A frame in processing: images, pose, labels, and the time of each stage."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.detector import DynamicDetector
from dudmap.core.dynamics.image_motion import TrackedImage
from dudmap.core.dynamics.masks import Labels, full_mask
from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Level, Observation, Pyramid, reduced, saturated
from dudmap.core.shed import Shed
from dudmap.core.state import CACHE
from dudmap.core.tracking.observability import unobserved_motion
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import ACCEPTED, Outcome


class StageTimer:
    """Milliseconds per processing stage, summed. A nested stage does not count for the outer one.

    Args:
        timings: Earlier milliseconds per stage.
    """

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}
        self._running: tuple | None = None  # stage, start, milliseconds within the outer stage, the outer stage
        self._stage = ""
        self._within = 0.0  # milliseconds of the stages nested in the present one

    @property
    def stage(self) -> str:
        """The running stage; empty for none."""
        return "" if self._running is None else self._running[0]

    def __call__(self, stage: str) -> "StageTimer":
        """Context manager that measures a block; a block left by an exception does not count."""
        self._stage = stage
        return self

    def __enter__(self) -> None:
        self._running = self._stage, time.perf_counter(), self._within, self._running
        self._within = 0.0

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._running is not None
        stage, start, before, self._running = self._running
        within, self._within = self._within, before
        if kind is None:
            ms, timings = 1000 * (time.perf_counter() - start), self.timings
            timings[stage] = (timings[stage] if stage in timings else 0.0) + ms - within
            self._within += ms


TEXTURELESS = 0.01
"""Standard deviation of intensities (0..1) below which an image carries no information: black or saturated."""
EXPOSED, USUAL_INTENSITY = (0.2, 0.75), 0.4
"""Mean intensities of normally exposed images, and target mean of other first images."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """A preprocessed frame, independent of other frames.

    Attributes:
        observation: Preprocessed images.
        levels: Returns the image pyramid.
        segmentation: Returns the surface segments of ``pyramid.labelled``; waits for their thread.
        timer: Collects the time of each stage.
        known_dynamic: (H, W) bool, pixels that the caller declares dynamic; None for none.
        blind: The image is textureless unlike the first image of the map, or the light has changed too much. Only the
            distances determine the pose; the frame is not fused.
        color_velocity: (6,) twist of the camera per second that registered the colours.
        shed: Omitted work.
        colors: Returns the observation with registered colours; None if they are registered.
    """

    observation: Observation
    levels: Callable[[], Pyramid]
    segmentation: Callable[[], Segmentation]
    timer: StageTimer = field(default_factory=StageTimer, metadata=CACHE)
    known_dynamic: NDArray[np.bool_] | None = None
    blind: bool = False
    shed: Shed = field(default=Shed.NOTHING, metadata=CACHE)
    color_velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))
    colors: Callable[[], Observation] | None = None

    @classmethod
    def of(
        cls, observation: Observation, config: Config, detector: DynamicDetector, *, now: bool = True
    ) -> "FrameView":
        """A preprocessed frame; pyramid and segments are computed ``now`` or on demand."""
        _ = observation.num_readings  # cached for the result
        levels = cache(lambda: Pyramid.of(observation, observation.camera, config))
        if now:
            levels()
        return cls(observation, levels, detector.segment(levels, config.volume.voxel_size, now=now))

    @property
    def timestamp(self) -> float:
        """Time of the depth image, seconds."""
        return self.observation.timestamp

    @property
    def without_image(self) -> bool:
        """Whether only the distances determine the pose."""
        return self.blind or not self.observation.has_color

    def colored(self) -> Observation:
        """The observation with registered colours; waits for their thread."""
        if self.colors is None:
            return self.observation
        with self.timer("color"):
            return self.colors()

    @property
    def pyramid(self) -> Pyramid:
        """Image pyramid."""
        return self.levels()

    @property
    def labelled(self) -> Level:
        """Pyramid level whose pixels are labelled."""
        return self.pyramid.labelled

    def tracked_at(self, T_world_camera: NDArray[np.float64], **attributes: Any) -> TrackedImage:  # noqa: ANN401
        """Image of the frame at a pose (4, 4), for comparison."""
        return TrackedImage(self.timestamp, T_world_camera, self.pyramid, self.segmentation(), **attributes)

    @property
    def brightness(self) -> float:
        """Mean intensity of the pixels with depth, so that a dark background does not count; of all pixels if there are
        none."""
        coarse = self.pyramid.coarse
        return float((coarse.intensity[coarse.depth > 0] if coarse.depth.any() else coarse.intensity).mean())

    @property
    def first_gain(self) -> float:
        """Gain of the first frame of a map. Cameras often start before their exposure has settled, and later frames
        adopt its exposure."""
        mean = self.brightness
        return 1.0 if self.textureless or EXPOSED[0] <= mean <= EXPOSED[1] else USUAL_INTENSITY / mean

    @property
    def textureless(self) -> bool:
        """Whether the intensities carry no information."""
        import cv2

        _, deviation = cv2.meanStdDev(self.pyramid.coarse.intensity)
        return bool(deviation[0, 0] < TEXTURELESS)


PREVIOUSLY_DYNAMIC_WEIGHT = 0.1
"""Weight of previously dynamic pixels in the first registration."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Registered and labelled frame.

    Attributes:
        tracking: Last registration.
        labels: Static probabilities and dynamic pixels; None without labelling or for the first frame of a map.
        view: The frame with registered colours; None if unchanged.
        from_corners: Whether corners of the last image determine the directions that the view does not observe.
    """

    tracking: TrackingResult
    labels: Labels | None = None
    view: FrameView | None = None
    from_corners: bool = False

    @classmethod
    def at_origin(cls, gain: float = 1.0, T_world_camera: NDArray[np.float64] | None = None) -> "PoseEstimate":
        """Estimate of the first frame of a map. Its colours times ``gain`` are the map's. The pose (4, 4) defaults to
        the identity."""
        T_world_camera = np.eye(4) if T_world_camera is None else T_world_camera
        return cls(TrackingResult(T_world_camera, (gain, 0.0), ACCEPTED, 1.0, 0.0, 1.0, 0))

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Camera pose (4, 4)."""
        return self.tracking.T_world_camera

    @property
    def exposure(self) -> tuple[float, float]:
        """Gain and offset from the frame's intensities to the map's."""
        return self.tracking.exposure

    @property
    def is_observed(self) -> bool:
        """Whether view or corners determine all directions of motion."""
        return self.from_corners or len(self.tracking.unobservable) == 0

    def doubts(self, view: FrameView) -> tuple[Outcome, Outcome]:
        """Why the pose is uncertain: unobserved directions, or changed light with a mostly saturated image."""
        free, corners = self.tracking.unobservable, "corners" if self.from_corners else ""
        level = view.labelled
        dark = saturated(level, self.exposure)
        share = 0.0 if dark is None else np.count_nonzero(dark & (level.depth > 0)) / max(level.num_readings, 1)
        return (
            Outcome.of("unobservable", len(free), 0, unobserved_motion(free), overruled_by=corners),
            Outcome.of("saturated", share, 0.5, "the light has changed, and {figure:.0%} of the image is saturated"),
        )

    def dynamic_mask(self, view: FrameView) -> NDArray[np.bool_]:
        """Dynamic pixels (H, W), labelled or known before."""
        with view.timer("label"):
            if self.labels is None:
                mask = np.zeros(view.observation.depth.shape, dtype=bool)
            else:
                mask = full_mask(self.labels, view.labelled, view.observation.depth)
            return mask if view.known_dynamic is None else mask | view.known_dynamic


def static_weights(
    labels: Labels, levels: list[Level], undecided: NDArray[np.bool_] | None = None
) -> list[NDArray[np.float32]]:
    """Weights (h, w) of the second registration at each level; 0 for undecided pixels."""
    import cv2

    static = labels.static_probability
    if undecided is not None:
        static = static * ~undecided
    return [
        np.asarray(cv2.resize(static, level.depth.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
        for level in levels
    ]


def initial_weights(
    levels: list[Level], previously_dynamic: NDArray[np.bool_] | None, excluded: list[NDArray[np.bool_]]
) -> list[NDArray[np.float32]] | None:
    """Weights of the first registration; None = 1 for every pixel.

    Args:
        levels: Pyramid levels.
        previously_dynamic: (h, w) bool, dynamic pixels of the previous frame, whose weight is reduced.
        excluded: Masks of any size of pixels without weight.
    """
    if previously_dynamic is None and not excluded:
        return None
    out = []
    for level in levels:
        if previously_dynamic is None:
            weights = np.ones(level.depth.shape, np.float32)
        else:
            reduction = np.float32(1 - PREVIOUSLY_DYNAMIC_WEIGHT)
            weights = np.float32(1) - reduction * reduced(previously_dynamic, level)
        for mask in excluded:
            weights *= ~reduced(mask, level)
        out.append(weights)
    return out
