"""The tree of coordinate frames of a bag, from /tf_static and /tf."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory

STATIC_TOPIC, TOPIC = "/tf_static", "/tf"
LARGEST_GAP = 0.2
"""Poses are not interpolated across gaps longer than this, seconds: a motion capture at 10 Hz may miss one."""


class TransformTree:
    """Motions between named frames: each frame has one parent, and its motions by time, of which a static one has one.

    Names count without the leading slash that tf wrote and tf2 does not.
    """

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._motions: dict[str, dict[float, NDArray[np.float64]]] = {}

    def add(self, messages: Iterable[Any], *, static: bool) -> None:
        """Add tf messages; static ones replace all others of their frame."""
        for stamped in (stamped for message in messages for stamped in message.transforms):
            child, stamp = stamped.child_frame_id.lstrip("/"), stamped.header.stamp
            self._parents[child] = stamped.header.frame_id.lstrip("/")
            motions = {} if static else self._motions.get(child, {})
            motions[stamp.sec + 1e-9 * stamp.nanosec] = motion_of(stamped.transform)
            self._motions[child] = motions

    def between(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Motion (4, 4) of points of ``source`` into ``target`` along frames that do not move, None if there is none.

        A frame that /tf repeats without change does not move.
        """
        up, down = self._path(source), self._path(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        T_common_source, T_common_target = (self._fixed(path[: path.index(common)]) for path in (up, down))
        if T_common_source is None or T_common_target is None:
            return None
        return se3.inverse(T_common_target) @ T_common_source

    def reaches(self, world: str, frame: str) -> bool:
        """Whether ``frame`` hangs below ``world``."""
        return world.lstrip("/") in self._path(frame)[1:]

    def trajectory(self, world: str, frame: str, stamps: NDArray[np.float64]) -> Trajectory | None:
        """Poses of ``frame`` in ``world`` at those of the times (N,) that all motions on the way cover.

        Motions are interpolated on the screw between their neighbours in time.
        """
        path = self._path(frame)
        if world.lstrip("/") not in path:
            return None
        series = []
        for child in path[: path.index(world.lstrip("/"))]:
            times = sorted(self._motions[child])
            series.append((np.array(times), np.array([self._motions[child][time] for time in times])))
        poses = []
        for stamp in stamps:
            T = np.eye(4)
            for times, Ts in series:
                link = _at(times, Ts, stamp)
                if link is None:
                    break
                T = link @ T
            else:
                poses.append((float(stamp), T))
        return Trajectory.from_poses(poses) if poses else None

    def _path(self, frame: str) -> list[str]:
        """The frame and its ancestors."""
        path = [frame.lstrip("/")]
        while (parent := self._parents.get(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def _fixed(self, children: list[str]) -> NDArray[np.float64] | None:
        """Motion of points of the first of the frames into the parent of the last one; None if it changes."""
        T = np.eye(4)
        for child in children:
            link, *others = self._motions[child].values()
            if not all(np.allclose(link, other, atol=1e-6) for other in others):
                return None
            T = link @ T
        return T


def _at(times: NDArray[np.float64], Ts: NDArray[np.float64], stamp: float) -> NDArray[np.float64] | None:
    """Motion at a time, None outside the series and in its gaps; a single motion holds always."""
    if len(times) == 1:
        return Ts[0]
    k = int(np.searchsorted(times, stamp, side="right"))
    if k == 0 or stamp > times[-1] or times[min(k, len(times) - 1)] - times[k - 1] > LARGEST_GAP:
        return None
    return se3.interpolate_in_time(times, Ts, float(stamp))


def motion_of(transform: Any) -> NDArray[np.float64]:  # noqa: ANN401 - the type is made from its definition
    """Motion (4, 4) of a geometry_msgs/Transform."""
    T = np.eye(4)
    r, t = transform.rotation, transform.translation
    T[:3, :3] = se3.quat_xyzw_to_rotation(np.array([r.x, r.y, r.z, r.w]))
    T[:3, 3] = t.x, t.y, t.z
    return T
