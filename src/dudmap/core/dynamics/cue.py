"""Further evidence of motion, for example from a segmentation network."""

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from dudmap.core.map.volume import TsdfVolume

if TYPE_CHECKING:
    from dudmap.core.tracking.frame_view import FrameView


class Cue(Protocol):
    """Evidence of motion at the pixels of a frame, added to distances and free space before segments share it."""

    def log_odds(
        self, volume: TsdfVolume, view: "FrameView", T_world_camera: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Log odds moving : static (h, w) of the labelled pixels, 0 for no evidence; more than 12 overrules the map.

        Args:
            volume: The map.
            view: The frame; ``view.labelled`` has camera, depth and intensity (h, w).
            T_world_camera: (4, 4).
        """
        ...
