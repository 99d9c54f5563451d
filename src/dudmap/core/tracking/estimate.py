"""Pose and labels of one frame, and the registration weights that follow from labels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.dynamics.masks import Labels, full_mask
from dudmap.core.frames.observation import Level
from dudmap.core.frames.pyramid import reduced
from dudmap.core.tracking.frame_view import FrameView
from dudmap.core.tracking.observability import unobserved_motion
from dudmap.core.tracking.tracker import TrackingResult

PREVIOUSLY_DYNAMIC_WEIGHT = 0.1
"""Weight in the first registration of pixels that were dynamic in the previous frame."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Result of registering and labelling a frame.

    Attributes:
        tracking: Result of the last registration.
        labels: Static probabilities and dynamic pixels; None where labelling is switched off or the frame starts a map.
        unverified_mask: (h, w) bool, label resolution, pixels that ego-motion could not verify as static while most of
            the view moves; None for none.
        view: The frame with the colours that were registered; None where those it was given with were.
    """

    tracking: TrackingResult
    labels: Labels | None = None
    unverified_mask: NDArray[np.bool_] | None = None
    view: FrameView | None = None

    @classmethod
    def at_origin(cls) -> "PoseEstimate":
        """Estimate of the frame that defines the world frame."""
        return cls(TrackingResult(np.eye(4), (1.0, 0.0), True, "", 1.0, 0.0, 1.0, 0))

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Camera pose (4, 4)."""
        return self.tracking.T_world_camera

    @property
    def exposure(self) -> tuple[float, float]:
        """Gain and offset that map the frame's intensities to those of the map."""
        return self.tracking.exposure

    @property
    def unobserved_motion(self) -> str:
        """Reason why the pose is uncertain: directions that the view does not determine; empty if there are none."""
        return unobserved_motion(self.tracking.unobservable)

    def dynamic_mask(self, view: FrameView) -> NDArray[np.bool_]:
        """Dynamic pixels (H, W) of the frame, of the labels and of those that are known before."""
        with view.timer("label"):
            if self.labels is None:
                mask = np.zeros(view.observation.depth.shape, dtype=bool)
            else:
                mask = full_mask(self.labels, view.labelled, view.observation.depth)
            return mask if view.known_dynamic is None else mask | view.known_dynamic


def static_weights(
    labels: Labels, levels: list[Level], unverified_mask: NDArray[np.bool_] | None = None
) -> list[NDArray[np.float32]]:
    """Weights (h, w) of the second registration at each level: the static probability, 0 for unverified pixels."""
    import cv2

    static = labels.static_probability
    if unverified_mask is not None:
        static = static * ~unverified_mask
    return [
        np.asarray(cv2.resize(static, level.depth.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
        for level in levels
    ]


def initial_weights(
    levels: list[Level], previously_dynamic: NDArray[np.bool_] | None, excluded: list[NDArray[np.bool_]]
) -> list[NDArray[np.float32]] | None:
    """Weights of the first registration, before the frame is labelled; None counts every pixel fully.

    Args:
        levels: Pyramid levels.
        previously_dynamic: (h, w) bool, dynamic pixels of the previous frame; their weight is reduced.
        excluded: Masks of any size of pixels that get no weight.
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
