"""Rigid fusion: a map and a trajectory for every moving object that proves to be rigid.

An object is registered to its own map and fused there (thesis section 4.4; Ruenz and Agapito, Co-Fusion, 2017).
Rigidity is measured: later frames observe the surface of a rigid object again, but see through the old surface of a
leg. Camera pose and static map do not depend on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.dynamics.masks import full_size
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, Observation, exposed_color
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.objects.object_map import ObjectTrack, ObjectVolume, RigidObject
from dudmap.core.objects.object_tracker import MEMORY, VELOCITY_WINDOW, Mover
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.checks import RegistrationRules
from dudmap.core.tracking.tracker import Tracker, TrackingResult

RULES = RegistrationRules(damping=1e-4, min_overlap=0.1, min_condition=1e-6, min_information=0.0)
"""Rules for an object: it fills a small part of the view and may turn about an axis of symmetry."""
MAX_OBJECTS = 4
"""Objects registered in one frame."""
MAX_MESHES = 50
"""Meshes of objects that are no longer tracked."""
MAX_SEEN_THROUGH = 0.08
"""Largest share of a rigid object's surface that a frame sees through."""
MAX_OFF_SURFACE = 0.25
"""Largest share of a rigid object's measurements that contradict its map."""
YOUNG_FRAMES = 10
"""Fused frames after which a misfit counts against rigidity; younger maps restart."""
GROWN = 1.5
"""Visible surface, relative to the start of the map, that restarts a young map."""
MAX_RESTARTS = 20
"""Largest number of restarts of a map."""
COLOR_SHARE = 0.3
"""Weight of intensity relative to the camera's: shading changes on rotating objects."""
MAX_POINTS = 2000
"""Surface points in the check for being seen through."""
MIN_PIXELS = 60
"""Fewest pixels of an object: ten per degree of freedom."""
MAX_PIXELS = 16000
"""Pixels of an object in registration and fusion; a larger view is halved."""
MIN_SIZE = 16 << 3
"""Width and height of the crop, pixels: at least 16 after three halvings."""
RIM = 0.05
"""Excluded mask border, share of the mask's size, because of grazing angles."""


@dataclass(frozen=True, eq=False)
class ObjectView:
    """Object in a frame: image pyramid of the crop around it.

    Attributes:
        weights: Per level (h, w) float32, 1 at pixels of the object, else 0.
        color: (h, w, 3) colours of the finest level.
    """

    levels: list[Level]
    weights: list[NDArray[np.float32]]
    color: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels (h, w) of the finest level that show the object."""
        return self.weights[-1] > 0

    @property
    def area(self) -> float:
        """Visible surface across the line of sight, square metres."""
        level = self.levels[-1]
        return float(np.sum(np.square(level.depth[self.mask]))) / (level.camera.fx * level.camera.fy)


def crop_object(
    observation: Observation, mover: Mover, level: Level, exposure: tuple[float, float]
) -> ObjectView | None:
    """Crop of a frame around an object, at most MAX_PIXELS of it; None if the object is too small.

    The mask belongs to ``level``. ``exposure``: gain and offset for the frame's intensities.
    """
    import cv2

    if np.count_nonzero(mover.mask) < MIN_PIXELS:
        return None
    stride = observation.camera.width // mover.mask.shape[1]
    rows, columns = np.flatnonzero(mover.mask.any(axis=1)), np.flatnonzero(mover.mask.any(axis=0))
    small_crop = tuple(
        _padded_range(indices, MIN_SIZE // stride, size)
        for indices, size in zip((rows, columns), mover.mask.shape, strict=True)
    )
    crop = tuple(slice(part.start * stride, part.stop * stride) for part in small_crop)
    depth = np.ascontiguousarray(observation.depth[crop])
    mask = full_size(mover.mask[small_crop], level.depth[small_crop], depth).astype(np.uint8)
    margin = max(2, round(RIM * float(np.sqrt(np.count_nonzero(mask)))))
    mask = cv2.erode(mask, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    pixels = int(np.count_nonzero(mask))
    finest = 0
    while pixels >> (2 * finest) > MAX_PIXELS:
        finest += 1
    y, x = crop[0].start, crop[1].start
    full = observation.camera
    camera = replace(full, cx=full.cx - x, cy=full.cy - y, width=crop[1].stop - x, height=crop[0].stop - y)
    gain, offset = np.float32(exposure[0]), np.float32(exposure[1])
    levels, weights = [], []
    for halvings in range(finest + 2, finest - 1, -1):
        if min(camera.width, camera.height) >> halvings < 16:
            continue
        scaled = camera.scaled(halvings)
        cut = np.s_[y >> halvings : (y >> halvings) + scaled.height, x >> halvings : (x >> halvings) + scaled.width]
        depth, intensity = (np.ascontiguousarray(image[cut]) for image in observation.halved(halvings))
        inner = cv2.resize(mask.astype(np.float32), (scaled.width, scaled.height), interpolation=cv2.INTER_AREA) > 0.99
        levels.append(Level(scaled, depth, gain * intensity + offset))
        weights.append((inner & (depth > 0)).astype(np.float32))
    if np.count_nonzero(weights[-1]) < MIN_PIXELS:
        return None
    color = exposed_color(np.ascontiguousarray(observation.rgb[crop]), exposure)
    if finest:
        color = np.asarray(cv2.resize(color, weights[-1].shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return ObjectView(levels, weights, color)


def _padded_range(indices: NDArray[np.int64], shortest: int, size: int) -> slice:
    start, stop = int(indices[0]) - 1, int(indices[-1]) + 2
    missing = max(0, shortest - (stop - start))
    start, stop = start - missing // 2, stop + (missing + 1) // 2
    if stop > size:
        start, stop = start - (stop - size), size
    start = max(start, 0)
    return slice(start, min(max(stop, start + shortest), size))


class ObjectFusion(Stateful):
    """Shape and trajectory of the moving objects of a sequence."""

    _rng: Remembered[np.random.Generator]
    _tracks: Remembered[dict[int, ObjectTrack]]
    _closed: Remembered[set[int]]
    _results: Remembered[list[tuple[RigidObject, dict[float, NDArray[np.float64]]]]]

    def __init__(self, config: Config) -> None:
        self.config = config
        tracker = config.tracker.model_copy(
            update={
                "iterations": (8, 8, 6),
                "exposure": False,
                "color_weight": COLOR_SHARE * config.tracker.color_weight,
            }
        )
        self.tracker = Tracker(tracker, config.sensor, config.preprocess.smoothing_px, RULES)
        self._volume_config = config.volume.model_copy(update={"voxel_size": config.movers.mesh_voxel_size})
        self._rng = np.random.default_rng(0)
        self._tracks = {}
        self._closed = set()
        self._results = []

    def objects(self, poses: dict[float, NDArray[np.float64]]) -> list[RigidObject]:
        """All objects so far, by number, with trajectories from the camera poses (4, 4) by time."""
        out = []
        for result, Ts in self._results + [track.result() for track in self._tracks.values()]:
            if result.mesh is not None:
                known = [(t, poses[t] @ T) for t, T in Ts.items() if t in poses]
                result = replace(result, trajectory=Trajectory.from_poses(known))
            out.append(result)
        return sorted(out, key=lambda result: result.id)

    def update(
        self,
        observation: Observation,
        movers: Sequence[Mover],
        level: Level,
        T_world_camera: NDArray[np.float64],
        exposure: tuple[float, float],
    ) -> list[Mover]:
        """Register and fuse the objects of a tracked frame, whose masks belong to ``level``; return the objects.

        An established object gets the velocity of its map's centre.
        """
        now = observation.timestamp
        for id, track in list(self._tracks.items()):
            if now - track.last_seen > MEMORY:
                self._close(id)
        for mover in sorted(movers, key=lambda mover: -np.count_nonzero(mover.mask)):
            track = self._tracks.get(mover.id)
            if mover.id in self._closed or (track is None and len(self._tracks) >= MAX_OBJECTS):
                continue
            view = crop_object(observation, mover, level, exposure)
            if view is None:
                continue
            if track is None:
                self._start(mover, view, now, T_world_camera)
                continue
            self._register_and_fuse(track, mover, view, observation, T_world_camera)
            misfit = track.misfits[0] if track.misfits else ""
            young = len(track.Ts_camera_object) < YOUNG_FRAMES and len(track.restarts) < MAX_RESTARTS
            if young and (misfit or view.area > GROWN * track.area):
                self._start(mover, view, now, T_world_camera, (*track.restarts, misfit))
            elif track.rejection_reason(final=False):
                self._close(mover.id)
        return [self._with_velocity(mover, now) for mover in movers]

    def _with_velocity(self, mover: Mover, now: float) -> Mover:
        track = self._tracks.get(mover.id)
        if track is None or len(track.Ts_camera_object) < YOUNG_FRAMES:
            return mover
        if track.last_seen != now or len(track.recent_poses) < 3:
            return mover
        centre = np.append((track.points.min(axis=0) + track.points.max(axis=0)) / 2, 1.0)
        positions = np.array([T[:3] @ centre for _, T in track.recent_poses])
        times = np.array([time for time, _ in track.recent_poses])
        times = times - times.mean()
        return replace(mover, velocity=times @ positions / np.sum(times**2))

    def _close(self, id: int) -> None:
        result, Ts = self._tracks.pop(id).result()
        self._closed.add(id)
        if result.rigid and sum(other.rigid for other, _ in self._results) >= MAX_MESHES:
            result = RigidObject(id, False, f"{MAX_MESHES} meshes are kept already", result.frames)
        self._results.append((result, Ts if result.rigid else {}))

    def _start(
        self,
        mover: Mover,
        view: ObjectView,
        now: float,
        T_world_camera: NDArray[np.float64],
        restarts: tuple[str, ...] = (),
    ) -> None:
        T = np.eye(4)
        T[:3, 3] = mover.centroid
        volume = ObjectVolume(
            view.levels[-1].camera, self._volume_config, self.config.sensor, self.config.preprocess.depth_max
        )
        track = ObjectTrack(mover.id, volume, view.area, T, T.copy(), now, now, restarts=restarts)
        track.velocity[:3] = mover.velocity
        self._tracks[mover.id] = track
        self._fuse(track, view, se3.inverse(T) @ T_world_camera, now)

    def _register_and_fuse(
        self,
        track: ObjectTrack,
        mover: Mover,
        view: ObjectView,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
    ) -> None:
        now, duration = observation.timestamp, observation.timestamp - track.last_seen
        still = np.zeros(3)
        velocities = (
            track.velocity,
            np.concatenate([mover.velocity, still]),
            np.concatenate([track.velocity[:3], still]),
        )
        predictions = [_predicted(track.T_world_object, velocity, duration) for velocity in velocities]
        result = self._align(track.volume, view, [se3.inverse(T) @ T_world_camera for T in predictions])
        T_object_camera = result.T_world_camera
        track.last_seen = now
        track.registrations += 1
        if not result.accepted:
            track.misfits.append(result.verdict.reason)
            track.velocity = np.concatenate([mover.velocity, np.zeros(3)])
            track.T_world_object = predictions[1]
            return
        seen_through = self._seen_through_share(track, observation, T_object_camera)
        off_surface = self._off_surface_share(track, view, T_object_camera)
        T = T_world_camera @ se3.inverse(T_object_camera)
        rotation = (T @ se3.inverse(track.T_world_object))[:3, :3]
        translation = T[:3, 3] - track.T_world_object[:3, 3]
        track.velocity = np.concatenate([translation, se3.log_rotation(rotation)]) / duration
        track.T_world_object = T
        track.recent_poses = [pose for pose in track.recent_poses if now - pose[0] < VELOCITY_WINDOW] + [(now, T)]
        if seen_through > MAX_SEEN_THROUGH:
            track.misfits.append(f"{seen_through:.0%} of its surface is seen through")
        elif off_surface > MAX_OFF_SURFACE:
            track.misfits.append(f"{off_surface:.0%} of its surface does not fit")
        if seen_through <= 2 * MAX_SEEN_THROUGH and off_surface <= MAX_OFF_SURFACE:
            self._fuse(track, view, T_object_camera, now)

    def _align(self, volume: ObjectVolume, view: ObjectView, guesses: list[NDArray[np.float64]]) -> TrackingResult:
        volume.look_at(guesses[0])
        systems = [self.tracker.linearize(volume, view.levels[0], T, view.weights[0]) for T in guesses]
        T = guesses[int(np.argmin([system.cost for system in systems]))]
        weights = []
        for level, weight in zip(view.levels, view.weights, strict=True):
            sample = volume.sample(level.depth, level.intensity, level.camera, T)
            weights.append(weight * np.isfinite(sample.distance).astype(np.float32))
        return self.tracker.align(volume, view.levels, T, weights, first_level=3 - len(view.levels))

    def _fuse(self, track: ObjectTrack, view: ObjectView, T_object_camera: NDArray[np.float64], now: float) -> None:
        level, mask = view.levels[-1], view.mask
        track.volume.camera = level.camera
        track.volume.integrate(Frame(now, level.depth, view.color), T_object_camera, mask)
        track.Ts_camera_object[now] = se3.inverse(T_object_camera)
        flat = np.flatnonzero(mask)
        flat = self._rng.choice(flat, min(len(flat), MAX_POINTS // 10), replace=False)
        v, u = np.divmod(flat, mask.shape[1])
        points = level.camera.points(u, v, level.depth.reshape(-1)[flat])
        points = (points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]).astype(np.float32)
        kept = track.points
        if len(kept) + len(points) > MAX_POINTS:  # a random sample of all fused points
            kept = kept[self._rng.permutation(len(kept))[: MAX_POINTS - len(points)]]
        track.points = np.concatenate([kept, points])
        sample = track.points[:: max(1, len(track.points) // 50)].astype(np.float64)
        change = track.T_world_object[:3] - track.T_first[:3]
        displacement = float(np.median(np.linalg.norm(sample @ change[:, :3].T + change[:, 3], axis=1)))
        track.max_displacement = max(track.max_displacement, displacement)

    def _seen_through_share(
        self, track: ObjectTrack, observation: Observation, T_object_camera: NDArray[np.float64]
    ) -> float:
        """Share of the object's unoccluded fused surface in front of the measurements."""
        T, camera = se3.inverse(T_object_camera), observation.camera
        points = track.points @ T[:3, :3].T + T[:3, 3]
        pixels, z = np.rint(camera.project(points)), points[:, 2]
        inside = (z > 0.1) & (pixels >= 3).all(axis=1) & (pixels < [camera.width - 3, camera.height - 3]).all(axis=1)
        u, v = pixels[inside].astype(np.int64).T
        z = z[inside]
        around = np.stack([observation.depth[v + dv, u + du] for du, dv in ((0, 0), (3, 0), (-3, 0), (0, 3), (0, -3))])
        around = np.where(around > 0, around, np.inf)
        nearest = around.min(axis=0)
        margin = np.float32(0.03) + 3 * self.config.sensor.sigma(z)
        read = np.isfinite(around[0])
        seen_through = read & (nearest > z + margin)
        seen = read & (np.abs(around - z).min(axis=0) <= margin)
        return float(np.count_nonzero(seen_through) / max(np.count_nonzero(seen_through | seen), 1))

    def _off_surface_share(self, track: ObjectTrack, view: ObjectView, T_object_camera: NDArray[np.float64]) -> float:
        """Share of the object's measurements in the truncation band that lie off its surface."""
        level = view.levels[-1]
        sample = track.volume.sample(level.depth, level.intensity, level.camera, T_object_camera)
        known = view.mask & np.isfinite(sample.distance)
        sigma = self.config.sensor.sigma(level.depth[known])
        off = np.abs(sample.distance[known]) > 0.005 + 1.5 * sigma
        return float(np.count_nonzero(off) / max(np.count_nonzero(known), 1))


def _predicted(
    T_world_object: NDArray[np.float64], velocity: NDArray[np.float64], duration: float
) -> NDArray[np.float64]:
    T = T_world_object.copy()
    T[:3, 3] += velocity[:3] * duration
    T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), velocity[3:] * duration]))[:3, :3] @ T[:3, :3]
    return T
