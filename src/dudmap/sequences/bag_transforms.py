"""The tree of coordinate frames of a bag, from /tf_static and /tf."""

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.geometry import se3
from dudmap.geometry.trajectory import Trajectory

STATIC_TOPIC, TOPIC = "/tf_static", "/tf"
LARGEST_GAP = 0.2
"""Poses are not interpolated across gaps longer than this, seconds: a motion capture at 10 Hz may miss one."""


class TransformTree:
    """Motions between named frames: each frame has one parent, and a motion over time or a static one.

    Attributes:
        parents: Parent of each frame.
    """

    def __init__(self) -> None:
        self.parents: dict[str, str] = {}
        self._static: dict[str, NDArray[np.float64]] = {}
        self._moving: dict[str, dict[float, NDArray[np.float64]]] = {}

    def add(self, messages: Iterable[Any], *, static: bool) -> None:
        """Add tf messages."""
        for message in messages:
            for stamped in message.transforms:
                child = normal(stamped.child_frame_id)
                self.parents[child] = normal(stamped.header.frame_id)
                T = _motion(stamped.transform)
                if static:
                    self._static[child] = T
                else:
                    stamp = stamped.header.stamp
                    self._moving.setdefault(child, {})[stamp.sec + 1e-9 * stamp.nanosec] = T

    def between(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Motion (4, 4) of points of ``source`` into ``target`` along frames that do not move, None if there is none.

        A frame that /tf repeats without change does not move.
        """
        up, down = self._path(normal(source)), self._path(normal(target))
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        T_common_source = self._fixed(up[: up.index(common) + 1])
        T_common_target = self._fixed(down[: down.index(common) + 1])
        if T_common_source is None or T_common_target is None:
            return None
        return se3.inverse(T_common_target) @ T_common_source

    def reaches(self, world: str, frame: str) -> bool:
        """Whether ``frame`` hangs below ``world``."""
        return normal(world) in self._path(normal(frame))[1:]

    def trajectory(self, world: str, frame: str, stamps: NDArray[np.float64]) -> Trajectory | None:
        """Poses of ``frame`` in ``world`` at those of the times (N,) that all motions on the way cover.

        Motions are interpolated on the screw between their neighbours in time.
        """
        path = self._path(normal(frame))
        if normal(world) not in path:
            return None
        path = path[: path.index(normal(world)) + 1]
        series = {
            child: (np.array(sorted(rows)), np.array([rows[time] for time in sorted(rows)]))
            for child in path[:-1]
            if (rows := self._moving.get(child))
        }
        poses = []
        for stamp in stamps:
            T = np.eye(4)
            for child in path[:-1]:
                link = self._static.get(child)
                if link is None:
                    link = _at(*series[child], stamp)
                if link is None:
                    break
                T = link @ T
            else:
                poses.append((float(stamp), T))
        return Trajectory.from_poses(poses) if poses else None

    def _path(self, frame: str) -> list[str]:
        """The frame and its ancestors."""
        path = [frame]
        while (parent := self.parents.get(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def _fixed(self, path: list[str]) -> NDArray[np.float64] | None:
        """Motion of points of the first frame of a path into the last one; None if it changes."""
        T = np.eye(4)
        for child, _ in pairwise(path):
            link = self._static.get(child)
            if link is None:
                link, *others = self._moving[child].values()
                if not all(np.allclose(link, other, atol=1e-6) for other in others):
                    return None
            T = link @ T
        return T


def normal(frame: str) -> str:
    """Name of a frame without the leading slash that tf wrote and tf2 does not."""
    return frame.lstrip("/")


def _at(times: NDArray[np.float64], Ts: NDArray[np.float64], stamp: float) -> NDArray[np.float64] | None:
    """Motion at a time, None outside the series and in its gaps; a single motion holds always."""
    if len(times) == 1:
        return Ts[0]
    k = int(np.searchsorted(times, stamp, side="right"))
    if k == 0 or stamp > times[-1] or times[min(k, len(times) - 1)] - times[k - 1] > LARGEST_GAP:
        return None
    return se3.interpolate_in_time(times, Ts, float(stamp))


def _motion(transform: Any) -> NDArray[np.float64]:  # noqa: ANN401 - the type is made from the bag
    T = np.eye(4)
    r, t = transform.rotation, transform.translation
    T[:3, :3] = se3.quat_xyzw_to_rotation(np.array([r.x, r.y, r.z, r.w]))
    T[:3, 3] = t.x, t.y, t.z
    return T
