"""Kept frames that newer ones replace are removed, so that their number grows with the space that was seen.

The map is a running average whose weight is capped: of many readings of a surface only the newest count in it, and a
kept frame whose view was fused often enough afterwards would hardly change a rebuilt map. The pose graph then grows
with the space and not with the time (Johannsson, Kaess, Fallon and Leonard 2013, the reduced pose graph).
"""

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_store import CELLS
from dudmap.core.places.loop_correction import LoopCorrector, odometry_sigmas
from dudmap.core.places.loop_verification import LOCAL_ANGLE_DEG, LOCAL_DISTANCE, LOCAL_FRAMES

SAME_DISTANCE, SAME_ANGLE_DEG = 0.25, 15.0
"""Views within this distance (m) and angle (deg) of each other show the same: half of what separates keyframes."""
MIN_KEPT = 256
"""Kept frames of which none is removed: 50 MB at 640x480. Recordings of some minutes give fewer."""


class FrameThinning:
    """Removes kept frames of the current submap whose view newer ones show.

    A frame is removed when, in every cell of its image that it was fused in, newer frames of the same view
    (SAME_DISTANCE, SAME_ANGLE_DEG) stand for more than ``similarity.threshold`` of the readings that the running
    average of a voxel can hold: what is seen behind somebody who stays there is kept. LOCAL_FRAMES of them must have
    been kept before any keyframe nearby was last seen: a return to its place is compared with what was kept until then.
    The nearest of the latter replaces the frame: its corrections are those of the frame, too, and motions measured to
    the frame go over to it. The tracked motion from the frame before to the one after keeps the noise of both parts.

    Args:
        config: Used are ``volume`` and ``similarity.threshold``.
        atlas: The submaps; nothing is removed without a frame store.
        corrector: Its measured motions refer to kept frames.
    """

    def __init__(self, config: Config, atlas: Atlas, corrector: LoopCorrector) -> None:
        self.atlas, self.corrector = atlas, corrector
        # an average capped at N readings has the variance of the mean of 2 N + 1: a / (2 - a) with a = 1 / (N + 1)
        held = 2 * min(config.volume.max_readings, config.volume.max_weight) + 1
        self._enough = config.similarity.threshold * held
        self._newest = -1  # serial of the newest frame seen here

    def thin(self) -> None:
        """Test the frames with the view of the newest one if that was stored since the last call; call it with every
        frame."""
        history = self.atlas.history
        if history is None or len(history) <= MIN_KEPT or self.atlas.rebuildings or self.atlas.repainting:
            return
        if history.serials[-1] == self._newest:
            return
        self._newest = history.serials[-1]
        nodes = self.atlas.nodes(self.atlas.current)
        Ts = np.array([history.Ts_world_camera[n] for n in nodes])
        same = 1 + np.flatnonzero(_same_view(Ts[1:-1], Ts[-1]))  # the first one fixes the world
        for serial in [history.serials[nodes[i]] for i in same]:  # the oldest first
            i = nodes.index(bisect_left(history.serials, serial))
            replacement = self._replacement(nodes, Ts, i)
            if replacement is not None and len(history) > MIN_KEPT:
                self._remove(nodes[i - 1 : i + 2], nodes[replacement])
                nodes, Ts = self.atlas.nodes(self.atlas.current), np.delete(Ts, i, axis=0)

    def _replacement(self, nodes: list[int], Ts: NDArray[np.float64], i: int) -> int | None:
        """Position of the frame that is to replace frame ``nodes[i]``; None if that must stay.

        Args:
            nodes: Numbers of the frames of the submap.
            Ts: (n, 4, 4) their poses.
            i: Position of the frame.
        """
        history = self.atlas.history
        assert history is not None
        newer = i + 1 + np.flatnonzero(_same_view(Ts[i + 1 :], Ts[i]))
        cells = np.array([history.cells[nodes[j]] for j in (i, *newer)], np.int64)
        fused = (cells[:, None] >> np.arange(np.prod(CELLS))) & 1
        readings = np.array([history.counts[nodes[j]] for j in newer], np.int64) @ fused[1:]
        if np.any(readings[fused[0] > 0] < self._enough):
            return None
        nearby = self.atlas.keyframes.near(Ts[i], self.atlas.current, 2 * LOCAL_DISTANCE, 2 * LOCAL_ANGLE_DEG)
        seen = [keyframe.last_seen for keyframe in nearby if keyframe.last_seen >= history.timestamps[nodes[i]]]
        newer = newer[[history.timestamps[nodes[j]] <= min(seen, default=np.inf) for j in newer]]
        if len(newer) < LOCAL_FRAMES:
            return None
        T_newer_frame = se3.inverse(Ts[newer]) @ Ts[i]
        return int(
            newer[np.argmin(np.linalg.norm(T_newer_frame[:, :3, 3], axis=1) + se3.rotation_angles(T_newer_frame))]
        )

    def _remove(self, numbers: list[int], replacement: int) -> None:
        """Remove the second of three kept frames that follow each other in the submap."""
        history = self.atlas.history
        assert history is not None
        Ts = np.array([history.Ts_world_camera[n] for n in numbers])
        first, second = [history.links.get(history.serials[n]) or (sigma, sigma)
                         for n, sigma in zip(numbers[1:], odometry_sigmas(Ts), strict=True)]  # fmt: skip
        distance = float(np.linalg.norm((se3.inverse(Ts[1]) @ Ts[2])[:3, 3]))
        self.corrector.move_edges(numbers[1], replacement)
        history.remove(numbers[1], replacement, chained(first, second, distance))


def chained(first: tuple[float, float], second: tuple[float, float], distance: float) -> tuple[float, float]:
    """Standard deviations, metres and radians, of one motion after another.

    The angle of the first one moves the end of the second, ``distance`` metres away, in the two directions across. That
    this depends on the angle of the whole is left out: edges have one deviation for all axes.
    """
    swing = 2 / 3 * (first[1] * distance) ** 2  # mean over the axes
    return float(np.sqrt(first[0] ** 2 + second[0] ** 2 + swing)), float(np.hypot(first[1], second[1]))


def _same_view(Ts: NDArray[np.float64], T: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which poses (n, 4, 4) have the view of a pose (4, 4)."""
    relative = se3.inverse(T) @ Ts
    near = np.linalg.norm(relative[:, :3, 3], axis=1) < SAME_DISTANCE
    return near & (se3.rotation_angles(relative) < np.radians(SAME_ANGLE_DEG))
