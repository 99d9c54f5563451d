"""Removal of stored images that newer frames replace: their number grows with space, not time.

The pose stays in the pose graph.
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_store import CELLS, FrameStore
from dudmap.core.places.loop_verification import LOCAL_ANGLE_DEG, LOCAL_DISTANCE, LOCAL_FRAMES
from dudmap.core.state import Remembered, Stateful

SAME_DISTANCE, SAME_ANGLE_DEG = 0.25, 15.0
"""Largest distance (reference depths) and angle (deg) between equal views: half the keyframe spacing."""
MIN_KEPT = 256
"""Frames that always keep images: 50 MB at 640x480."""


class FrameThinning(Stateful):
    """Removes the images of frames of the current submap whose view newer frames show (SAME_DISTANCE, SAME_ANGLE_DEG).

    * They fill every cell that the frame was fused in, with more than ``similarity.threshold`` of the measurements of a
      running average.
    * At least LOCAL_FRAMES of them were stored before any nearby keyframe was last seen, for loop verification.
    """

    _stored: Remembered[int] = 0  # number of frames stored until the last call

    def __init__(self, config: Config, atlas: Atlas) -> None:
        self.atlas = atlas
        # an average capped at N measurements has the variance of the mean of 2 N + 1: a / (2 - a) with a = 1 / (N + 1)
        held = 2 * min(config.volume.max_readings, config.volume.max_weight) + 1
        self._enough = config.similarity.threshold * held

    def thin(self) -> None:
        """Test the frames with the view of a new stored frame; call with every frame."""
        history = self.atlas.history
        if history is None or self.atlas.rebuildings or self.atlas.repainting or len(history) == self._stored:
            return
        self._stored, spare = len(history), len(history.kept) - MIN_KEPT
        if spare <= 0:
            return
        nodes = self.atlas.kept_nodes(self.atlas.current)
        Ts = np.array([history.frames[n].T_world_camera for n in nodes])
        # oldest first; the first frame fixes the world
        for i in 1 + np.flatnonzero(_same_view(Ts[1:-1], Ts[-1], self.atlas.unit)):
            if spare > 0 and self._is_replaced(history, nodes, Ts, int(i)):
                history.remove_images(nodes[i])
                spare -= 1

    def _is_replaced(self, history: FrameStore, nodes: list[int], Ts: NDArray[np.float64], i: int) -> bool:
        """Whether newer frames replace frame ``nodes[i]``."""
        newer = i + 1 + np.flatnonzero(_same_view(Ts[i + 1 :], Ts[i], self.atlas.unit))
        cells = np.array([history.frames[nodes[j]].cells for j in (i, *newer)], np.int64)
        fused = (cells[:, None] >> np.arange(np.prod(CELLS))) & 1
        readings = np.array([history.frames[nodes[j]].count for j in newer], np.int64) @ fused[1:]
        if np.any(readings[fused[0] > 0] < self._enough):
            return False
        first = history.frames[nodes[i]].timestamp
        reach = 2 * LOCAL_DISTANCE * self.atlas.unit
        nearby = self.atlas.keyframes.near(Ts[i], self.atlas.current, reach, 2 * LOCAL_ANGLE_DEG)
        until = min((keyframe.last_seen for keyframe in nearby if keyframe.last_seen >= first), default=np.inf)
        return sum(history.frames[nodes[j]].timestamp <= until for j in newer) >= LOCAL_FRAMES


def _same_view(Ts: NDArray[np.float64], T: NDArray[np.float64], unit: float) -> NDArray[np.bool_]:
    relative = se3.inverse(T) @ Ts
    near = np.linalg.norm(relative[:, :3, 3], axis=1) < SAME_DISTANCE * unit
    return near & (se3.rotation_angles(relative) < np.radians(SAME_ANGLE_DEG))
