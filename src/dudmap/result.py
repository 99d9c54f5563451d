"""What one frame gave, and how long each stage took."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dudmap.dynamics.masks import Labels
from dudmap.objects.object_tracker import Mover
from dudmap.tracking.tracker import TrackingResult


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What one frame gave.

    Attributes:
        timestamp: Seconds, of the depth image.
        state: "tracked" or "lost".
        lost_reason: The check that failed, empty for a tracked frame.
        T_world_camera: (4, 4), None if lost.
        fused: Whether the frame changed the map.
        skipped_similar: Whether it was left out of the fusion as a redundant view.
        blind: Whether its image showed nothing (black, say) and the distances alone gave the pose; it is not fused.
        relocalized: Whether tracking was lost and the pose comes from a place that was recognised.
        dynamic_mask: (H, W) bool, in the image as it was recorded.
        dynamic_share: Share of the readings that lie in the mask.
        residuals: (h, w) float32 signed distance to the map in metres at the label resolution, NaN off the map.
        labels: The label step's full outcome, None where it did not run.
        tracking: The registration's full outcome, None for the first frame.
        timings: Milliseconds per stage.
        movers: The moving bodies, by number; none in a lost frame.
        submap: Number of the map that the pose belongs to, 0 the first.
        corrected: Whether a known place was seen again here and all poses so far have moved.
    """

    timestamp: float
    state: Literal["tracked", "lost"]
    lost_reason: str
    T_world_camera: NDArray[np.float64] | None
    fused: bool
    skipped_similar: bool
    dynamic_mask: NDArray[np.bool_]
    dynamic_share: float
    residuals: NDArray[np.float32]
    labels: Labels | None
    tracking: TrackingResult | None
    timings: dict[str, float] = field(default_factory=dict)
    relocalized: bool = False
    movers: tuple[Mover, ...] = ()
    submap: int = 0
    corrected: bool = False
    blind: bool = False
