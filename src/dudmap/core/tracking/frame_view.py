"""A frame on its way through the algorithm, and the time that each stage takes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.frames.pyramid import Pyramid
from dudmap.core.state import CACHE


class StageTimer:
    """Milliseconds per stage of the processing of a frame; the times of a stage that runs twice are added.

    A stage that runs within another one counts for itself alone, so that no time is counted twice.

    Args:
        timings: Milliseconds per stage that were measured before.
    """

    def __init__(self, timings: dict[str, float] | None = None) -> None:
        self.timings = timings or {}
        self._running: tuple | None = None  # stage, start, milliseconds within the outer stage, the outer stage
        self._stage = ""
        self._within = 0.0  # milliseconds of the stages that ran within the one that is running

    @property
    def stage(self) -> str:
        """The stage that is running; empty outside of all."""
        return "" if self._running is None else self._running[0]

    def __call__(self, stage: str) -> "StageTimer":
        """Context manager that measures a block of code; a block left by an exception is not counted."""
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
"""Standard deviation of the intensities (0..1) below which an image carries no information: black or saturated."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """A preprocessed frame with everything that needs no other frame.

    Attributes:
        observation: Preprocessed images.
        pyramid: Image pyramid of the observation.
        segmentation: Returns the surface segments of ``pyramid.labelled``, waiting for the thread that computes them.
        timer: Collects the processing time of each stage.
        known_dynamic: (H, W) bool, pixels that the caller declares dynamic; None for none.
        blind: The image is textureless although the first image of the map was not: the pose rests on the distances
            alone, and the frame is not fused.
        color_velocity: (6,) twist of the camera per second with which the colours were registered.
    """

    observation: Observation
    pyramid: Pyramid
    segmentation: Callable[[], Segmentation]
    timer: StageTimer = field(default_factory=StageTimer, metadata=CACHE)
    known_dynamic: NDArray[np.bool_] | None = None
    blind: bool = False
    color_velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))

    @property
    def timestamp(self) -> float:
        """Time of the depth image, seconds."""
        return self.observation.timestamp

    @property
    def labelled(self) -> Level:
        """Pyramid level whose pixels are labelled."""
        return self.pyramid.labelled

    @property
    def textureless(self) -> bool:
        """Whether the intensities carry no information."""
        import cv2

        _, deviation = cv2.meanStdDev(self.pyramid.coarse.intensity)
        return bool(deviation[0, 0] < TEXTURELESS)
