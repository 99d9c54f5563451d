"""A frame on its way through the algorithm."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.segments import Segmentation
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.frames.pyramid import Pyramid
from dudmap.core.stage_timer import StageTimer

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
    timer: StageTimer
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
