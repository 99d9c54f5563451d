"""Atlas: submaps with their own world frames, keyframes, stored frames and trajectories.

Submaps are joined when one is recognised from another: Elvira, Tardos and Montiel, ORBSLAM-Atlas (2019).
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import exposed_color
from dudmap.core.frames.stream_check import Repeats
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.memory_limit import MemoryLimit, resident_bytes
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore, KeptFrame
from dudmap.core.places.map_rebuilding import MAX_ADDED, MAX_IMMEDIATE, PER_FRAME, MapRebuilding, nearest_views
from dudmap.core.places.place_recognition import Keyframe, KeyframeDatabase
from dudmap.core.places.saved_map import PriorMap, SavedMap
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.motion_model import VELOCITY_LIFETIME


@dataclass(eq=False)
class TimedPose:
    """Pose (4, 4) of a frame in the world of a submap; timestamp in seconds.

    ``repeats``: "" for a tracked frame; "depth" for a predicted pose; "frame" for a copied or interpolated one.
    ``late``: seconds from capture to time stamp of the depth image, by the calibration at tracking time.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    submap: int
    repeats: Repeats = ""
    late: float = 0.0


class Atlas(Stateful):
    """The submaps, and all poses that change when a submap is corrected or joined.

    Attributes:
        keyframes: Keyframes of all submaps.
        depth_late: Delay of the depth time stamps, seconds.
        saved: Number of the submap that began as a saved map, or None. Others are joined to it, and loop closures do
            not change it.
    """

    history: Remembered[FrameStore | None]
    keyframes: Remembered[KeyframeDatabase]
    volumes: Remembered[dict[int, TsdfVolume]]
    rebuildings: Remembered[dict[int, MapRebuilding]]
    repainting: Remembered[MapRebuilding | None] = None
    current: Remembered[int]
    poses: Remembered[list[TimedPose]]
    depth_late: Remembered[float] = 0.0
    saved: Remembered[int | None] = None

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
        self.rebuildings = {}
        self.current = number
        self.poses = []

    @classmethod
    def of(
        cls,
        config: Config,
        camera: Camera,
        make_volume: Callable[[], TsdfVolume],
        prior: PriorMap | None,
        *,
        keep_frames: bool,
    ) -> "Atlas":
        """An atlas with one empty map. ``keep_frames``: store frames for corrections if needed. A ``prior`` map of a
        first pass provides keyframes; no frames are stored then."""
        if prior is not None:
            return cls(make_volume, prior.keyframes, None, prior.submap)
        keyframes = KeyframeDatabase(config.relocalization, camera, config.sensor)
        return cls(make_volume, keyframes, FrameStore.of(config, camera) if keep_frames else None)

    def continue_in(self, saved: SavedMap, camera: Camera, max_blocks: int | MemoryLimit | None = None) -> None:
        """Make a saved map the current submap, with its volume and keyframes. ``max_blocks``: see ``TsdfVolume``."""
        self.saved = self.current
        self.volumes[self.current] = saved.volume.for_camera(camera, self.volume.backend, max_blocks)
        self.keyframes.keyframes += [replace(keyframe, submap=self.current) for keyframe in saved.keyframes]

    @property
    def unit(self) -> float:
        """Reference depth, metres: the unit of constant lengths."""
        return self.keyframes.sensor.reference_depth

    @property
    def volume(self) -> TsdfVolume:
        """The map of the current submap."""
        return self.volumes[self.current]

    def integrate(
        self,
        frame: Frame,
        static_mask: NDArray[np.bool_],
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float] = (1.0, 0.0),
        recorded: Frame | None = None,
    ) -> None:
        """Fuse the static pixels of a frame into the current map, and store it for corrections.

        ``exposure``: gain and offset to the map's colours. ``recorded``: the frame with its recorded colour, which is
        stored (None = ``frame``).
        """
        color = exposed_color(frame.rgb, exposure)
        self.volume.integrate(Frame(frame.timestamp, frame.depth, color), T_world_camera, static_mask)
        if self.history is not None:
            self.history.add(recorded or frame, static_mask, T_world_camera, self.current, exposure)

    def recolor(self) -> None:
        """Repaint all maps but a saved one under the present calibration, the current one during the next frames."""
        assert self.history is not None
        self.complete()
        for number in self.volumes:
            if number == self.saved:
                continue
            self.repainting = MapRebuilding.of(self.history, number, self.make_volume())
            if number != self.current:
                self._complete_repainting()
        self.switch_to(self.current)

    def take_repainted(self) -> bool:
        """Take the colours of a complete repainting; returns whether no repainting is left."""
        if self.repainting is not None and not self.repainting.missing:
            self._complete_repainting()
        return self.repainting is None

    def _complete_repainting(self) -> None:
        repainting, self.repainting = self.repainting, None
        if repainting is not None:
            repainting.fuse()
            self.volumes[repainting.submap].take_colors(repainting.volume)

    def velocity_at(self, timestamp: float) -> NDArray[np.float64]:
        """Twist per second (6,), camera axes, at a tracked frame; 0 if unknown."""
        number = min(bisect_left(self.poses, timestamp, key=lambda pose: pose.timestamp), len(self.poses) - 1)
        near = [
            pose
            for pose in self.poses[max(number - 1, 0) : number + 2]
            if abs(pose.timestamp - timestamp) <= VELOCITY_LIFETIME
            and pose.submap == self.poses[number].submap
            and (not pose.repeats or pose.timestamp == timestamp)
        ]
        if len(near) < 2:
            return np.zeros(6)
        motion = se3.log(se3.inverse(near[0].T_world_camera) @ near[-1].T_world_camera)
        return motion / (near[-1].timestamp - near[0].timestamp)

    def as_saved_map(self) -> SavedMap:
        """The main map and its keyframes, without registration history."""
        self.complete()
        self.keyframes.settle()
        main = self.by_size()[0]
        return SavedMap(self.volumes[main], [one for one in self.keyframes.keyframes if one.submap == main])

    def clear_map(self) -> None:
        """Empty the current map and forget its stored frames."""
        self.volume.clear()
        if self.history is not None:
            self.history.remove_submap(self.current)

    def add_pose(self, timestamp: float, T_world_camera: NDArray[np.float64], repeats: Repeats = "") -> None:
        """Append the pose (4, 4) of a frame in the current submap. A tracked pose replaces predicted ones since the
        last by interpolation."""
        new = TimedPose(timestamp, T_world_camera, self.current, repeats, self.depth_late)
        first = len(self.poses)
        while repeats != "depth" and first and self.poses[first - 1].repeats == "depth":
            first -= 1
        if 0 < first < len(self.poses) and self.poses[first - 1].submap == self.current:
            ends = self.poses[first - 1], new
            stamps, Ts = (np.array([getattr(end, name) for end in ends]) for name in ("timestamp", "T_world_camera"))
            for pose in self.poses[first:]:
                pose.T_world_camera = se3.interpolate_in_time(stamps, Ts, pose.timestamp)
                pose.repeats = "frame"
        self.poses.append(new)

    def start_submap(self) -> None:
        """Start an empty submap."""
        number = max(self.volumes) + 1
        self.switch_to(number)
        self.volumes[number] = self.make_volume()

    def switch_to(self, number: int) -> None:
        """Make a submap current, and page out the others."""
        self.current = number
        for other, volume in self.volumes.items():
            if other != number:
                volume.page_out()

    def make_room(self) -> None:
        """Page the current map out unless a second map of the view fits into the memory limit."""
        limit = None if self.volume.pager is None else self.volume.pager.max_blocks
        if isinstance(limit, MemoryLimit):
            if limit.limit - resident_bytes() < self.volume.view_bytes:
                self.volume.page_out()

    def volume_around(self, number: int, T_world_camera: NDArray[np.float64]) -> TsdfVolume:
        """Map of a submap; during a rebuilding, with the surroundings of a pose (4, 4)."""
        if number in self.rebuildings:
            self.rebuildings[number].show(self.volumes[number], T_world_camera, MAX_ADDED)
        return self.volumes[number]

    def continue_rebuilding(self) -> None:
        """Advance the repainting and one rebuilding by ``PER_FRAME`` frames each, the current submap first."""
        if self.repainting is not None:
            self.repainting.fuse(PER_FRAME)
        if not self.rebuildings:
            return
        number = self.current if self.current in self.rebuildings else min(self.rebuildings)
        rebuilding, shown, last = self.rebuildings[number], 0, self.poses[-1]
        if last.submap == number:
            shown = rebuilding.show(self.volumes[number], last.T_world_camera, 1)
        if rebuilding.fuse(PER_FRAME - shown):
            self._take(rebuilding)

    def complete(self) -> None:
        """Complete all rebuilding and repainting."""
        self._complete_repainting()
        for rebuilding in list(self.rebuildings.values()):
            self.volumes[rebuilding.submap].clear()  # makes room
            rebuilding.fuse()
            self._take(rebuilding)

    def _take(self, rebuilding: MapRebuilding) -> None:
        volume = self.volumes[rebuilding.submap]
        volume.take_over(rebuilding.volume)
        del self.rebuildings[rebuilding.submap]
        if rebuilding.submap != self.current:
            volume.page_out()

    def by_size(self) -> list[int]:
        """Numbers of the submaps: the saved one, then by decreasing number of tracked frames."""
        sizes = {number: sum(pose.submap == number for pose in self.poses) for number in self.volumes}
        return sorted(self.volumes, key=lambda number: (number != self.saved, -sizes[number]))

    def image_poses(self, submap: int) -> Trajectory:
        """Poses of a submap at the capture times of the depth images."""
        return Trajectory.from_poses(
            (pose.timestamp, pose.T_world_camera) for pose in self.poses if pose.submap == submap
        )

    def trajectory(self, submap: int) -> Trajectory:
        """Poses of a submap at the time stamps of the frames."""
        return self.image_poses(submap).after(np.array([pose.late for pose in self.poses if pose.submap == submap]))

    def nodes(self, submap: int) -> list[int]:
        """Stored frames of a submap, see ``FrameStore.in_submap``."""
        return [] if self.history is None else self.history.in_submap(submap)

    def kept_nodes(self, submap: int) -> list[int]:
        """Stored frames of a submap with images."""
        return [] if self.history is None else self.history.kept_of(submap)

    def correct(
        self,
        nodes: list[int],
        Ts_new: NDArray[np.float64],
        volume: TsdfVolume,
        fused: Sequence[int] | None = None,
    ) -> NDArray[np.float64]:
        """Set new poses of the stored frames of the current submap, and replace its map.

        Trajectory and keyframes receive the correction interpolated in time. ``volume`` was built from the stored
        frames ``nodes`` at poses (n, 4, 4), or only from ``fused`` and is then provisional. Returns the motion (4, 4)
        of the newest stored frame.
        """
        assert self.history is not None
        frames = [self.history.frames[n] for n in nodes]
        stamps = np.array([frame.timestamp for frame in frames])
        corrections = np.stack([T @ se3.inverse(frame.T_world_camera) for frame, T in zip(frames, Ts_new, strict=True)])
        self.move(stamps, corrections)
        self.volume.take_over(volume)
        for frame, T in zip(frames, Ts_new, strict=True):
            frame.T_world_camera = T  # exact: without the rounding of the correction
        self.rebuildings.pop(self.current, None)  # of an earlier correction
        if fused is not None and len(fused) < len(self.kept_nodes(self.current)):
            new = self.make_volume()
            self.rebuildings[self.current] = MapRebuilding.of(self.history, self.current, new, fused)
        return corrections[-1]

    def _places(self, submap: int) -> list[TimedPose | Keyframe | KeptFrame]:
        frames = [] if self.history is None else self.history.frames
        return [place for place in (*self.poses, *self.keyframes.places, *frames) if place.submap == submap]

    def move(self, stamps: NDArray[np.float64], corrections: NDArray[np.float64]) -> None:
        """Move all poses of the current submap by corrections (n, 4, 4), interpolated between their times (n,); cancels
        a repainting."""
        self.repainting = None
        for place in self._places(self.current):
            correction = se3.interpolate_in_time(stamps, corrections, place.timestamp)
            place.T_world_camera = correction @ place.T_world_camera

    def join(self, source: int, target: int, T_target_source: NDArray[np.float64]) -> None:
        """Join submap ``source`` into ``target``, the new current one; ``T_target_source`` (4, 4) maps world to
        world."""
        assert self.history is not None
        self._complete_repainting()
        moved_nodes = self.kept_nodes(source)
        for moved in self._places(source):
            moved.T_world_camera = T_target_source @ moved.T_world_camera
            moved.submap = target
        del self.volumes[source]
        self.rebuildings.pop(source, None)
        # a saved map cannot be rebuilt: not all its frames are stored
        if len(moved_nodes) <= MAX_IMMEDIATE or target == self.saved:
            self.history.reintegrate(self.volumes[target], moved_nodes)
            if target in self.rebuildings:
                self.rebuildings[target].add_shown(moved_nodes)
        else:
            nodes = np.array(self.kept_nodes(target))
            Ts = np.array([self.history.frames[n].T_world_camera for n in nodes])
            near = nodes[nearest_views(Ts, self.poses[-1].T_world_camera, MAX_IMMEDIATE, self.unit)].tolist()
            provisional = self.make_volume()
            self.history.reintegrate(provisional, near)
            self.volumes[target].take_over(provisional)
            self.rebuildings[target] = MapRebuilding.of(self.history, target, self.make_volume(), near)
        self.switch_to(target)
