"""The start of a map: its first frame, and the revision of that frame by the second."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.dynamics.masks import full_size
from dudmap.tracking.frame_view import FrameView

MIN_READINGS = 0.02
"""Share of the pixels of a first frame that must have a static depth reading."""


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """The frame that a map was made of.

    Attributes:
        view: The frame.
        dynamic_mask: (H, W) bool, pixels that were not fused.
    """

    view: FrameView
    dynamic_mask: NDArray[np.bool_]


class Bootstrap:
    """Knows which frame a map consists of while it is the only one, and what of it must be taken back.

    A single image does not tell what moves, so everything in the first frame is taken as static that the caller does
    not declare dynamic. The ego-motion to the second image shows what moved in the first.

    Attributes:
        textureless: Whether the image of the first frame carries no information: later ones are then not called blind.
    """

    def __init__(self) -> None:
        self.textureless = False
        self._first: FirstFrame | None = None

    @staticmethod
    def rejection_reason(view: FrameView, dynamic_mask: NDArray[np.bool_]) -> str:
        """Sentence on why a frame cannot start a map, empty if it can."""
        depth = view.observation.depth
        enough = np.count_nonzero(depth[~dynamic_mask]) >= MIN_READINGS * depth.size
        return "" if enough else "the depth image holds hardly any readings"

    def start(self, view: FrameView, dynamic_mask: NDArray[np.bool_]) -> None:
        """Remember the frame that a map was made of."""
        self._first = FirstFrame(view, dynamic_mask)

    def revised(self, moving_before: NDArray[np.bool_] | None) -> FirstFrame | None:
        """The first frame with the mask it should have been fused with; None where the map is right as it is.

        Args:
            moving_before: (h, w) bool, label resolution, what the second image shows to have moved in the first; None
                if that is not known yet.
        """
        if self._first is None or moving_before is None:
            return None
        first, self._first = self._first, None
        if not moving_before.any():
            return None
        view = first.view
        moving = full_size(moving_before, view.labelled.depth, view.observation.depth)
        return FirstFrame(view, first.dynamic_mask | moving)
