"""All that is known of the world: submaps, each in its own world frame, with their keyframes, frames and poses.

Several maps that are joined when one is recognised from another: Elvira, Tardos and Montiel, ORBSLAM-Atlas (2019).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.frames.frame import Frame
from dudmap.geometry import se3
from dudmap.geometry.trajectory import Trajectory
from dudmap.mapping.volume import TsdfVolume
from dudmap.places.frame_store import FrameStore
from dudmap.places.place_recognition import KeyframeDatabase


@dataclass(eq=False)
class TimedPose:
    """Pose of a tracked frame in the world of a submap."""

    timestamp: float
    T_world_camera: NDArray[np.float64]
    submap: int


class Atlas:
    """The submaps, and everything that moves along when one is corrected or joined with another.

    Args:
        make_volume: Makes an empty map.
        keyframes: Places that can be recognised.
        history: The fused frames, to build maps again; None where neither loops nor submaps are wanted.
        number: Of the first submap.

    Attributes:
        volumes: Map by number of the submap.
        current: Number of the submap that is tracked.
        poses: Of all tracked frames, in time.
    """

    def __init__(
        self,
        make_volume: Callable[[], TsdfVolume],
        keyframes: KeyframeDatabase,
        history: FrameStore | None,
        number: int = 0,
    ) -> None:
        self.make_volume = make_volume
        self.keyframes = keyframes
        self.history = history
        self.volumes = {number: make_volume()}
        self.current = number
        self.poses: list[TimedPose] = []

    @property
    def volume(self) -> TsdfVolume:
        """The map that is tracked."""
        return self.volumes[self.current]

    def integrate(self, frame: Frame, static_mask: NDArray[np.bool_], T_world_camera: NDArray[np.float64]) -> None:
        """Fuse the static pixels (H, W) of a frame into the current map, and keep the frame for later corrections."""
        self.volume.integrate(frame, T_world_camera, static_mask)
        if self.history is not None:
            self.history.add(frame, static_mask, T_world_camera, self.current)

    def clear_first_frame(self) -> None:
        """Empty the current map, which holds a single frame."""
        self.volume.clear()
        if self.history is not None:
            self.history.drop_last()

    def add_pose(self, timestamp: float, T_world_camera: NDArray[np.float64]) -> None:
        """Take over the pose of a tracked frame."""
        self.poses.append(TimedPose(timestamp, T_world_camera, self.current))

    def start_submap(self) -> None:
        """Go on in a new, empty map."""
        self.current = max(self.volumes) + 1
        self.volumes[self.current] = self.make_volume()

    def by_size(self) -> list[int]:
        """Numbers of the submaps, that with the most frames first."""
        return sorted(self.volumes, key=lambda number: -sum(pose.submap == number for pose in self.poses))

    def trajectory(self, submap: int) -> Trajectory:
        """Poses of the frames that were tracked in a submap."""
        return Trajectory.from_poses(
            (pose.timestamp, pose.T_world_camera) for pose in self.poses if pose.submap == submap
        )

    def nodes(self, submap: int) -> list[int]:
        """Numbers of the kept frames of a submap, in time."""
        return [] if self.history is None else [n for n, of in enumerate(self.history.submaps) if of == submap]

    def correct(self, nodes: list[int], Ts_new: NDArray[np.float64], volume: TsdfVolume) -> NDArray[np.float64]:
        """Move the kept frames of the current submap; everything else moves along, by time between them.

        Args:
            nodes: Numbers of all its kept frames, in time.
            Ts_new: (n, 4, 4) their new poses.
            volume: The map built from these.

        Returns:
            (4, 4) motion of what is newest.
        """
        assert self.history is not None
        stamps = np.array([self.history.timestamps[n] for n in nodes])
        corrections = np.stack(
            [T @ se3.inverse(self.history.Ts_world_camera[n]) for n, T in zip(nodes, Ts_new, strict=True)]
        )
        for place in (*self.poses, *self.keyframes.keyframes):
            if place.submap == self.current:
                place.T_world_camera = (
                    se3.interpolate_in_time(stamps, corrections, place.timestamp) @ place.T_world_camera
                )
        for n, T in zip(nodes, Ts_new, strict=True):
            self.history.Ts_world_camera[n] = T
        self.volume.take_over(volume)
        return corrections[-1]

    def join(self, source: int, target: int, T_target_source: NDArray[np.float64]) -> None:
        """Fuse a submap into another, whose world ``T_target_source`` maps into, and go on there."""
        assert self.history is not None
        nodes = self.nodes(source)
        for place in (*self.poses, *self.keyframes.keyframes):
            if place.submap == source:
                place.T_world_camera = T_target_source @ place.T_world_camera
                place.submap = target
        for n in nodes:
            self.history.Ts_world_camera[n] = T_target_source @ self.history.Ts_world_camera[n]
            self.history.submaps[n] = target
        self.history.reintegrate(self.volumes[target], nodes)
        del self.volumes[source]
        self.current = target
