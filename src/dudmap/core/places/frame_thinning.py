"""Stored frames that the map no longer knows of are removed, so that their number grows with the space that was seen.

The map is a running average whose weight is capped: of many readings of a surface only the newest count in it. A stored
frame of which newer ones saw everything again would hardly change a rebuilt map. This compresses the pose graph by the
information of its frames (Kretzschmar and Stachniss 2012), measured by what the map can hold, so that it grows with the
space and not with the time (Johannsson, Kaess, Fallon and Leonard 2013, the reduced pose graph).
"""

from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.glimpse import Visibility
from dudmap.core.places.loop_correction import LoopCorrector, odometry_sigmas
from dudmap.core.places.loop_verification import LOCAL_ANGLE_DEG, LOCAL_DISTANCE, LOCAL_FRAMES

NEAR_DISTANCE, NEAR_ANGLE_DEG = 0.5, 30.0
"""Frames within this distance (m) and angle (deg) of each other show the same place, as keyframes do."""
UNTOUCHED = 256
"""Stored frames of which none is removed: 50 MB at 640x480. Recordings of some minutes give fewer."""
TESTED = 4
"""Stored frames that are tested, in turn, when one was added. Where f frames must stay, about 4/3 f are stored: then
one of four tested may go."""
AT_ONCE = 64
"""Newer frames that are compared with one at once, the newest first, until they suffice."""


class FrameThinning:
    """Removes stored frames of the current submap that newer ones replace.

    Two things are asked of a frame. The first is whether the map still needs it. An average whose weight is capped at N
    readings has the variance a / (2 - a), a = 1 / (N + 1), of one reading: that of the mean of 2 N + 1 readings, and
    more it never holds. A frame is not needed if the newer ones that saw its points again give, on average over them,
    more than ``similarity.threshold`` of that, and each of its readings, and the free space before it, was seen again
    2 ``volume.free_after`` times, as a view is redundant that tells the map nothing new (``RedundantViews``).

    The second is whether it is needed to recognise a return: that takes the ``LOCAL_FRAMES`` nearest frames of a place
    that were stored until a keyframe was last seen. The frame is removed if so many newer ones that show the same place
    would do for each keyframe nearby. The nearest of them stands for it from then on: its corrections are
    those of the frame, too, and motions measured to the frame go over to it. The tracked motion from the frame before
    to the one after keeps the noise of both parts, as by marginalization.

    Args:
        config: Used are ``volume``, ``sensor`` and ``similarity.threshold``.
        atlas: The submaps; nothing is removed without a frame store.
        corrector: Its measured motions refer to stored frames.
    """

    def __init__(self, config: Config, atlas: Atlas, corrector: LoopCorrector) -> None:
        self.atlas, self.corrector = atlas, corrector
        self._visibility = Visibility(atlas.keyframes.camera, config)
        self._held = 2 * min(config.volume.max_readings, config.volume.max_weight) + 1  # readings, at most, in the map
        self._learnt = 2 * config.volume.free_after
        self._threshold = config.similarity.threshold
        self._newest = self._last = -1  # serials of the newest frame seen here, and of the one tested last

    def thin(self) -> None:
        """Test a few frames if one was stored since the last call; call it with every frame."""
        history = self.atlas.history
        if history is None or len(history) <= UNTOUCHED or self.atlas.rebuildings or self.atlas.repainting:
            return
        if history.serials[-1] == self._newest:
            return
        self._newest = history.serials[-1]
        nodes = self.atlas.nodes(self.atlas.current)
        Ts = np.array([history.Ts_world_camera[n] for n in nodes])
        inner = [history.serials[n] for n in nodes[1:-1]]  # the first one fixes the world, the last one is that of now
        begin = bisect_right(inner, self._last)
        for serial in (inner[begin:] + inner[:begin])[:TESTED]:
            i = bisect_left(nodes, bisect_left(history.serials, serial))
            heir, self._last = self._heir(nodes, Ts, i), serial
            if heir is not None:
                self._remove(nodes[i - 1 : i + 2], nodes[heir])
                nodes, Ts = self.atlas.nodes(self.atlas.current), np.delete(Ts, i, axis=0)
            if len(history) <= UNTOUCHED:
                break

    def _heir(self, nodes: list[int], Ts: NDArray[np.float64], i: int) -> int | None:
        """Position of the frame that is to stand for frame ``nodes[i]``; None if that must stay.

        Args:
            nodes: Numbers of the frames of the submap.
            Ts: (n, 4, 4) their poses.
            i: Position of the frame.
        """
        history = self.atlas.history
        assert history is not None
        until = self._exchangeable_until(Ts[i], history.timestamps[nodes[i]])
        newer = np.arange(i + 1, len(nodes))
        alike = newer[self._near(Ts[newer], Ts[i], NEAR_DISTANCE, NEAR_ANGLE_DEG)]
        alike = alike[[history.timestamps[nodes[j]] <= until for j in alike]]
        if len(alike) < LOCAL_FRAMES or not self._is_known(nodes, Ts, i):
            return None
        T_alike_frame = se3.inverse(Ts[alike]) @ Ts[i]
        return int(
            alike[np.argmin(np.linalg.norm(T_alike_frame[:, :3, 3], axis=1) + se3.rotation_angles(T_alike_frame))]
        )

    def _is_known(self, nodes: list[int], Ts: NDArray[np.float64], i: int) -> bool:
        """Whether newer frames tell what frame ``nodes[i]`` shows, too."""
        history = self.atlas.history
        assert history is not None
        points = self._visibility.points(history.glimpse(nodes[i]))
        if len(points) == 0:
            return True
        Ts_newer_frame = se3.inverse(Ts[i + 1 :]) @ Ts[i]
        looking = np.flatnonzero(self._visibility.in_view(np.median(points, axis=0)[None], Ts_newer_frame)[:, 0])[::-1]
        counts = np.array([history.counts[nodes[i + 1 + j]] for j in looking], float)
        if counts.sum() < self._threshold * self._held:
            return False
        readings = np.zeros(len(points))
        for begin in range(0, len(looking), AT_ONCE):
            some = looking[begin : begin + AT_ONCE]
            glimpses = [history.glimpse(nodes[i + 1 + j]) for j in some]
            seen = self._visibility.observed(points, Ts_newer_frame[some], glimpses)
            readings += counts[begin : begin + AT_ONCE] @ seen
            if readings.min() >= self._learnt and np.minimum(readings / self._held, 1).mean() > self._threshold:
                return True
        return False

    def _exchangeable_until(self, T_world_camera: NDArray[np.float64], timestamp: float) -> float:
        """Time up to which a newer frame may stand for a frame wherever a return to a place is compared with it.

        That is done with what was stored until the place was last seen. A frame that recognises a keyframe is taken to
        be as near to it as the stored frames it is compared with are to the former.
        """
        keyframes = [one for one in self.atlas.keyframes.keyframes
                     if one.submap == self.atlas.current and one.last_seen >= timestamp]  # fmt: skip
        Ts = np.reshape([one.T_world_camera for one in keyframes], (-1, 4, 4))
        near = self._near(Ts, T_world_camera, 2 * LOCAL_DISTANCE, 2 * LOCAL_ANGLE_DEG)
        return min((keyframes[n].last_seen for n in np.flatnonzero(near)), default=np.inf)

    @staticmethod
    def _near(Ts: NDArray[np.float64], T: NDArray[np.float64], distance: float, angle_deg: float) -> NDArray[np.bool_]:
        """Which poses (n, 4, 4) are nearer to a pose (4, 4) than a distance and an angle."""
        relative = se3.inverse(T) @ Ts
        return (np.linalg.norm(relative[:, :3, 3], axis=1) < distance) & (
            se3.rotation_angles(relative) < np.radians(angle_deg)
        )

    def _remove(self, numbers: list[int], heir: int) -> None:
        """Remove the second of three stored frames that follow each other in the submap; ``heir`` shows its place."""
        history = self.atlas.history
        assert history is not None
        Ts = np.array([history.Ts_world_camera[n] for n in numbers])
        first, second = [history.links.get(history.serials[n]) or (sigma, sigma)
                         for n, sigma in zip(numbers[1:], odometry_sigmas(Ts), strict=True)]  # fmt: skip
        distance = float(np.linalg.norm((se3.inverse(Ts[1]) @ Ts[2])[:3, 3]))
        self.corrector.move_edges(numbers[1], heir)
        history.remove(numbers[1], heir, chained(first, second, distance))


def chained(first: tuple[float, float], second: tuple[float, float], distance: float) -> tuple[float, float]:
    """Standard deviations, metres and radians, of one motion after another.

    The angle of the first one moves the end of the second, ``distance`` metres away, in the two directions across. That
    this depends on the angle of the whole is left out: edges have one deviation for all axes.
    """
    swing = 2 / 3 * (first[1] * distance) ** 2  # mean over the axes
    return float(np.sqrt(first[0] ** 2 + second[0] ** 2 + swing)), float(np.hypot(first[1], second[1]))
