"""Rigid fusion: a small map and a trajectory of its own for every moving body that proves to be rigid.

A body is registered to its own map as the camera is to the room's (thesis section 4.4), and fused there: Ruenz and
Agapito, Co-Fusion (2017). No classifier says what is rigid: what was fused of a rigid body is seen again wherever it
is not hidden, what was fused of a person's leg is soon seen through. Nothing here reaches the camera's pose or the map.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.frames.frame import Frame
from dudmap.frames.observation import Level, Observation
from dudmap.geometry import se3
from dudmap.geometry.trajectory import Trajectory
from dudmap.objects.object_map import ObjectTrack, ObjectVolume, RigidObject
from dudmap.objects.object_tracker import Mover
from dudmap.objects.object_view import ObjectView, crop_object
from dudmap.tracking.tracker import Tracker, TrackingResult

MOST_BODIES = 4
"""Bodies that are looked at in one frame; each costs a few milliseconds and some megabytes."""
MOST_MESHES = 50
"""Bodies out of sight whose mesh is kept."""
SEEN_THROUGH = 0.08
"""Largest share of a rigid body's surface that a frame sees through: edges of the mask, errors of the pose."""
OFF = 0.25
"""Largest share of a rigid body's readings that contradict its map."""
YOUNG = 10
"""Frames that a map must hold before a frame that does not fit speaks against it; until then it is begun anew, also
where much more of the body comes into view: what is built on a narrow strip is crooked."""
GROWN = 1.5
"""Visible surface, as a multiple of that at the beginning, that is much more."""
MOST_STARTS = 20
"""Times that a map is begun."""
COLOR = 0.3
"""Share of the usual weight that intensities have: light falls differently on a body that turns."""
POINTS = 2000
"""Surface points that are looked at again."""


class ObjectFusion:
    """Shape and trajectory of the moving bodies of a recording.

    Args:
        config: All parameters; of the tracker, the sensor and the maps.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        steps = config.tracker.model_copy(
            update={
                "iterations": (8, 8, 6),
                "damping": 1e-4,
                "exposure": False,
                "min_inliers": 0.1,
                "min_condition": 1e-6,
                "color_weight": COLOR * config.tracker.color_weight,
            }
        )
        self.tracker = Tracker(steps, config.sensor)
        self._volume = config.volume.model_copy(update={"voxel_size": config.movers.mesh_voxel_size})
        self._rng = np.random.default_rng(0)
        self._tracks: dict[int, ObjectTrack] = {}
        self._rejected: set[int] = set()
        self._finished: list[tuple[RigidObject, dict[float, NDArray[np.float64]]]] = []

    def bodies(self, poses: dict[float, NDArray[np.float64]]) -> list[RigidObject]:
        """All bodies so far, by id, with the trajectories that the camera's poses T_world_camera by time give them."""
        out = []
        for body, Ts in self._finished + [track.finished() for track in self._tracks.values()]:
            if body.mesh is not None:
                known = [(t, poses[t] @ T) for t, T in Ts.items() if t in poses]
                body = replace(body, trajectory=Trajectory.from_poses(known))
            out.append(body)
        return sorted(out, key=lambda body: body.id)

    def update(
        self,
        observation: Observation,
        movers: Sequence[Mover],
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
    ) -> list[Mover]:
        """Register and fuse the bodies of a tracked frame.

        Args:
            observation: The frame.
            movers: Its bodies.
            level: The image that their masks belong to.
            T_world_camera: (4, 4).
            exposure: Gain and offset of the frame.

        Returns:
            The movers, those that are followed with the velocity of their middle: the surface of a rolling ball, of
            which only the upper half is in view, is faster than the ball.
        """
        now = observation.timestamp
        for id, track in list(self._tracks.items()):
            if now - track.last_seen > self.config.movers.memory:
                self._finish(id)
        for mover in sorted(movers, key=lambda mover: -np.count_nonzero(mover.mask)):
            track = self._tracks.get(mover.id)
            if mover.id in self._rejected or (track is None and len(self._tracks) >= MOST_BODIES):
                continue
            view = crop_object(observation, mover, level, exposure)
            if view is None:
                continue
            if track is None:
                self._start(mover, view, now, T_world_camera)
                continue
            self._follow(track, mover, view, observation, T_world_camera)
            misfit = track.misfits[0] if track.misfits else ""
            young = len(track.Ts_camera_body) < YOUNG and len(track.begun) < MOST_STARTS
            if young and (misfit or view.area > GROWN * track.area):
                self._start(mover, view, now, T_world_camera, (*track.begun, misfit))
            elif track.why(final=False):
                self._finish(mover.id)
        return [self._with_velocity(mover, now) for mover in movers]

    def _with_velocity(self, mover: Mover, now: float) -> Mover:
        """A mover with the slope of a line through the places of its body's middle in the last while."""
        track = self._tracks.get(mover.id)
        if track is None or len(track.Ts_camera_body) < YOUNG or track.last_seen != now or len(track.recent) < 3:
            return mover
        points = np.append((track.points.min(axis=0) + track.points.max(axis=0)) / 2, 1.0)
        places = np.array([T[:3] @ points for _, T in track.recent])
        times = np.array([time for time, _ in track.recent])
        times = times - times.mean()
        return replace(mover, velocity=times @ places / np.sum(times**2))

    def _finish(self, id: int) -> None:
        body, Ts = self._tracks.pop(id).finished()
        self._rejected.add(id)
        if body.rigid and sum(other.rigid for other, _ in self._finished) >= MOST_MESHES:
            body = RigidObject(id, False, f"{MOST_MESHES} meshes are kept already", body.frames)
        self._finished.append((body, Ts if body.rigid else {}))

    def _start(
        self,
        mover: Mover,
        view: ObjectView,
        now: float,
        T_world_camera: NDArray[np.float64],
        begun: tuple[str, ...] = (),
    ) -> None:
        T = np.eye(4)
        T[:3, 3] = mover.centroid
        volume = ObjectVolume(
            view.levels[-1].camera, self._volume, self.config.sensor, self.config.preprocess.depth_max
        )
        track = ObjectTrack(mover.id, volume, view.area, T, T.copy(), now, now, begun=begun)
        track.motion[:3] = mover.velocity
        self._tracks[mover.id] = track
        self._fuse(track, view, se3.inverse(T) @ T_world_camera, now)

    def _follow(
        self,
        track: ObjectTrack,
        mover: Mover,
        view: ObjectView,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
    ) -> None:
        """Register a frame to the body's map; fuse it if it fits."""
        now, duration = observation.timestamp, observation.timestamp - track.last_seen
        turning, still = track.motion, np.zeros(3)
        motions = turning, np.concatenate([mover.velocity, still]), np.concatenate([turning[:3], still])
        guesses = [_predicted(track.T_world_body, motion, duration) for motion in motions]
        result = self._registered(track.volume, view, [se3.inverse(T) @ T_world_camera for T in guesses])
        T_body_camera = result.T_world_camera
        track.last_seen = now
        if not result.converged:
            track.misfits.append(result.reason)
            track.motion = np.concatenate([mover.velocity, np.zeros(3)])
            track.T_world_body = guesses[1]
            track.judged.append((np.nan, np.nan))
            return
        through = self._seen_through(track, observation, T_body_camera)
        off = self._off(track, view, T_body_camera)
        track.judged.append((through, off))
        T = T_world_camera @ se3.inverse(T_body_camera)
        move = T @ se3.inverse(track.T_world_body)
        track.motion = np.concatenate([T[:3, 3] - track.T_world_body[:3, 3], se3.log_rotation(move[:3, :3])]) / duration
        track.T_world_body = T
        track.recent = [old for old in track.recent if now - old[0] < self.config.movers.velocity_window] + [(now, T)]
        if through > SEEN_THROUGH or off > OFF:
            share, what = (through, "is seen through") if through > SEEN_THROUGH else (off, "does not fit")
            track.misfits.append(f"{share:.0%} of its surface {what}")
        if through <= 2 * SEEN_THROUGH and off <= OFF:
            self._fuse(track, view, T_body_camera, now)

    def _registered(self, volume: ObjectVolume, view: ObjectView, guesses: list[NDArray[np.float64]]) -> TrackingResult:
        """Pose T_body_camera from the best of some guesses.

        A reading that is off the map there is a side of the body not seen before: it has no say. In the camera's
        registration such a reading has its price, which would turn the body back towards what is known of it.
        """
        volume.look_at(guesses[0])
        systems = [self.tracker.linearize(volume, view.levels[0], T, view.weights[0]) for T in guesses]
        T = guesses[int(np.argmin([system.cost for system in systems]))]
        weights = []
        for level, mask in zip(view.levels, view.weights, strict=True):
            sample = volume.sample(level.depth, level.intensity, level.camera, T)
            weights.append(mask * np.isfinite(sample.distance).astype(np.float32))
        return self.tracker.align(volume, view.levels, T, weights, first_level=3 - len(view.levels))

    def _fuse(self, track: ObjectTrack, view: ObjectView, T_body_camera: NDArray[np.float64], now: float) -> None:
        level, mask = view.levels[-1], view.mask
        track.volume.camera = level.camera
        track.volume.integrate(Frame(now, level.depth, view.color), T_body_camera, mask)
        track.Ts_camera_body[now] = se3.inverse(T_body_camera)
        flat = np.flatnonzero(mask)
        flat = self._rng.choice(flat, min(len(flat), POINTS // 10), replace=False)
        v, u = np.divmod(flat, mask.shape[1])
        points = level.camera.points(u, v, level.depth.reshape(-1)[flat])
        points = (points @ T_body_camera[:3, :3].T + T_body_camera[:3, 3]).astype(np.float32)
        kept = track.points
        if len(kept) + len(points) > POINTS:  # a sample of all that was fused
            kept = kept[self._rng.permutation(len(kept))[: POINTS - len(points)]]
        track.points = np.concatenate([kept, points])
        corners = track.points[:: max(1, len(track.points) // 50)].astype(np.float64)
        change = track.T_world_body[:3] - track.T_first[:3]
        track.farthest = max(
            track.farthest, float(np.median(np.linalg.norm(corners @ change[:, :3].T + change[:, 3], axis=1)))
        )

    def _seen_through(self, track: ObjectTrack, observation: Observation, T_body_camera: NDArray[np.float64]) -> float:
        """Share of the body's known surface, as far as it is not hidden, that the image sees through."""
        T, camera, sensor = se3.inverse(T_body_camera), observation.camera, self.config.sensor
        x, y, z = (track.points @ T[:3, :3].T + T[:3, 3]).T
        inside = z > 0.1
        u, v = np.full(len(z), -1), np.full(len(z), -1)
        u[inside] = np.rint(x[inside] / z[inside] * camera.fx + camera.cx)
        v[inside] = np.rint(y[inside] / z[inside] * camera.fy + camera.cy)
        inside &= (u >= 3) & (v >= 3) & (u < camera.width - 3) & (v < camera.height - 3)
        u, v, z = u[inside], v[inside], z[inside]
        around = np.stack([observation.depth[v + dv, u + du] for du, dv in ((0, 0), (3, 0), (-3, 0), (0, 3), (0, -3))])
        around = np.where(around > 0, around, np.inf)
        nearest = around.min(axis=0)
        margin = np.float32(0.03) + 3 * (sensor.sigma_base + sensor.sigma_scale * z * z)
        read = np.isfinite(around[0])
        gone = read & (nearest > z + margin)
        seen = read & (np.abs(around - z).min(axis=0) <= margin)
        return float(np.count_nonzero(gone) / max(np.count_nonzero(gone | seen), 1))

    def _off(self, track: ObjectTrack, view: ObjectView, T_body_camera: NDArray[np.float64]) -> float:
        """Share of the body's readings near its map that lie off its surface."""
        level, sensor = view.levels[-1], self.config.sensor
        sample = track.volume.sample(level.depth, level.intensity, level.camera, T_body_camera)
        known = view.mask & np.isfinite(sample.distance)
        sigma = sensor.sigma_base + sensor.sigma_scale * level.depth[known] ** 2
        off = np.abs(sample.distance[known]) > 0.005 + 1.5 * sigma
        return float(np.count_nonzero(off) / max(np.count_nonzero(known), 1))


def _predicted(T_world_body: NDArray[np.float64], motion: NDArray[np.float64], duration: float) -> NDArray[np.float64]:
    """Pose after some seconds of a motion (6,): velocity of the origin and turning rate, world axes."""
    T = T_world_body.copy()
    T[:3, 3] += motion[:3] * duration
    T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), motion[3:] * duration]))[:3, :3] @ T[:3, :3]
    return T
