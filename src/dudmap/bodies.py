"""Rigid fusion: a small map and a trajectory of its own for every moving body that proves to be rigid.

A body is registered to its own map as the camera is to the room's (thesis section 4.4), and fused there: Ruenz and
Agapito, Co-Fusion (2017). No classifier says what is rigid: what was fused of a rigid body is seen again wherever it
is not hidden, what was fused of a person's leg is soon seen through. Nothing here reaches the camera's pose or the map.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap import se3
from dudmap.camera import Camera
from dudmap.config import Config, SensorConfig, VolumeConfig
from dudmap.dynamics import full_size
from dudmap.frame import Frame
from dudmap.mesh import Mesh
from dudmap.movers import Mover
from dudmap.preprocess import Observation, exposed_color, pyramid
from dudmap.tracker import Level, Tracker, TrackingResult
from dudmap.trajectory import Trajectory
from dudmap.volume import TsdfVolume

MOST_BODIES = 4
"""Bodies that are looked at in one frame; each costs a few milliseconds and some megabytes."""
MOST_MESHES = 50
"""Bodies out of sight whose mesh is kept."""
EXTENT = 1.0
"""The window of a body's map is that of a camera with readings up to this, metres: a cube of about 2.5 m."""
FEWEST_PIXELS = 60
"""Pixels at the labels' resolution that a body is looked at from."""
MOST_PIXELS = 16000
"""Pixels of a body that are registered and fused; a larger image of it is halved."""
LEAST = 128
"""Smallest width and height of the part of an image that is looked at, pixels."""
FEWEST_FRAMES = 10
"""Registrations that prove a body rigid."""
SHORTEST = 0.5
"""Time that proves a body rigid, seconds."""
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
FAILED = 0.3
"""Largest share of frames that do not fit a rigid body."""
FARTHEST_STILL = 0.03
"""What has not moved farther than this is no moving body, metres."""
COLOR = 0.3
"""Share of the usual weight that intensities have: light falls differently on a body that turns."""
RIM = 0.05
"""Width of the border of a body's image that is left out, as a share of its size: readings at grazing angles."""
FLECK = 0.05
"""Pieces of a mesh that have a smaller share of the largest piece's vertices than this are left out."""
POINTS = 2000
"""Surface points that are looked at again."""


@dataclass(frozen=True, eq=False)
class Body:
    """What is known of a moving body.

    Attributes:
        id: The mover's number.
        rigid: Whether it is one rigid thing that has moved.
        why: Why it is not, empty if it is.
        frames: Frames that it was registered in.
        mesh: Its shape, metres, body frame: the origin is the middle of the mesh's box, the axes are the world's at
            first sight. None if it is not rigid.
        trajectory: Its poses T_world_body, as the camera's poses are known now; None if it is not rigid.
    """

    id: int
    rigid: bool
    why: str
    frames: int
    mesh: Mesh | None = None
    trajectory: Trajectory | None = None


class BodyVolume(TsdfVolume):
    """The map of a body: its window stays around the body's origin wherever the camera is.

    Args:
        camera: Any; ``camera`` is set to that of each image.
        config: Voxel size, truncation, weights; a body's map is not carved.
        sensor: Noise of the depth readings.
        depth_max: Farthest reading, metres.
    """

    def __init__(self, camera: Camera, config: VolumeConfig, sensor: SensorConfig, depth_max: float) -> None:
        super().__init__(camera, config.model_copy(update={"carving": False}), sensor, depth_max, EXTENT)
        self._around = np.eye(4)
        self._around[2, 3] = -self._reach

    def look_at(self, T_world_camera: NDArray[np.float64]) -> None:
        """Lay the window around the origin."""
        del T_world_camera
        super().look_at(self._around)


@dataclass(frozen=True, eq=False)
class _View:
    """A body in an image: the levels around it, coarse to fine, their weights, and the finest one's colours."""

    levels: list[Level]
    weights: list[NDArray[np.float32]]
    color: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        return self.weights[-1] > 0

    @property
    def area(self) -> float:
        """Visible surface across the line of sight, square metres."""
        level = self.levels[-1]
        return float(np.sum(np.square(level.depth[self.mask]))) / (level.camera.fx * level.camera.fy)


@dataclass(eq=False)
class _Track:
    """A body that is being registered."""

    id: int
    volume: BodyVolume
    area: float
    T_world_body: NDArray[np.float64]
    T_first: NDArray[np.float64]
    first_seen: float
    last_seen: float
    motion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))  # m/s and rad/s, world axes
    Ts_camera_body: dict[float, NDArray[np.float64]] = field(default_factory=dict)
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), np.float32))
    misfits: list[str] = field(default_factory=list)  # what each frame that did not fit was refused for
    judged: list[tuple[float, float]] = field(default_factory=list)  # shares seen through and off, per frame
    farthest: float = 0.0
    recent: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)  # time and T_world_body
    begun: tuple[str, ...] = ()  # misfit that the map was begun anew for, each time; empty: more came into view


class RigidFusion:
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
        self._tracks: dict[int, _Track] = {}
        self._rejected: set[int] = set()
        self._finished: list[tuple[Body, dict[float, NDArray[np.float64]]]] = []

    def bodies(self, poses: dict[float, NDArray[np.float64]]) -> list[Body]:
        """All bodies so far, by id, with the trajectories that the camera's poses T_world_camera by time give them."""
        out = []
        for body, Ts in self._finished + [_finished(track) for track in self._tracks.values()]:
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
            view = _view(observation, mover, level, exposure)
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
            elif _why(track, final=False):
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
        body, Ts = _finished(self._tracks.pop(id))
        self._rejected.add(id)
        if body.rigid and sum(other.rigid for other, _ in self._finished) >= MOST_MESHES:
            body = Body(id, False, f"{MOST_MESHES} meshes are kept already", body.frames)
        self._finished.append((body, Ts if body.rigid else {}))

    def _start(
        self, mover: Mover, view: _View, now: float, T_world_camera: NDArray[np.float64], begun: tuple[str, ...] = ()
    ) -> None:
        T = np.eye(4)
        T[:3, 3] = mover.centroid
        volume = BodyVolume(view.levels[-1].camera, self._volume, self.config.sensor, self.config.preprocess.depth_max)
        track = _Track(mover.id, volume, view.area, T, T.copy(), now, now, begun=begun)
        track.motion[:3] = mover.velocity
        self._tracks[mover.id] = track
        self._fuse(track, view, se3.inverse(T) @ T_world_camera, now)

    def _follow(
        self,
        track: _Track,
        mover: Mover,
        view: _View,
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

    def _registered(self, volume: BodyVolume, view: _View, guesses: list[NDArray[np.float64]]) -> TrackingResult:
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

    def _fuse(self, track: _Track, view: _View, T_body_camera: NDArray[np.float64], now: float) -> None:
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

    def _seen_through(self, track: _Track, observation: Observation, T_body_camera: NDArray[np.float64]) -> float:
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

    def _off(self, track: _Track, view: _View, T_body_camera: NDArray[np.float64]) -> float:
        """Share of the body's readings near its map that lie off its surface."""
        level, sensor = view.levels[-1], self.config.sensor
        sample = track.volume.sample(level.depth, level.intensity, level.camera, T_body_camera)
        known = view.mask & np.isfinite(sample.distance)
        sigma = sensor.sigma_base + sensor.sigma_scale * level.depth[known] ** 2
        off = np.abs(sample.distance[known]) > 0.005 + 1.5 * sigma
        return float(np.count_nonzero(off) / max(np.count_nonzero(known), 1))


def _finished(track: _Track) -> tuple[Body, dict[float, NDArray[np.float64]]]:
    """What came of a body, and its poses T_camera_body by time."""
    why, frames = _why(track), len(track.Ts_camera_body)
    if why:
        return Body(track.id, False, why, frames), {}
    mesh = _without_flecks(track.volume.extract_mesh())
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    T = np.eye(4)
    T[:3, 3] = middle
    mesh = replace(mesh, vertices=mesh.vertices - middle)
    return Body(track.id, True, "", frames, mesh), {t: pose @ T for t, pose in track.Ts_camera_body.items()}


def _without_flecks(mesh: Mesh) -> Mesh:
    """The mesh without pieces that hang apart and are much smaller than the largest: readings beside the body."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = mesh.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    size = len(mesh.vertices)
    _, piece = connected_components(coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(size, size)), False)
    counts = np.bincount(piece)
    kept = (counts >= FLECK * counts.max())[piece]
    number = np.cumsum(kept) - 1
    faces = number[mesh.faces[kept[a]]].astype(np.int32)
    return Mesh(mesh.vertices[kept], faces, mesh.colors[kept], mesh.normals[kept])


def _why(track: _Track, *, final: bool = True) -> str:
    """Why a body is not rigid or not known to be; empty if it is, or before the end if nothing speaks against it."""
    judged, bad = len(track.judged), len(track.misfits)
    if judged >= FEWEST_FRAMES and bad > FAILED * judged:
        return f"not rigid: {bad} of {judged} frames do not fit, the last: {track.misfits[-1]}"
    if not final:
        return ""
    time = track.last_seen - track.first_seen
    if len(track.Ts_camera_body) < FEWEST_FRAMES or time < SHORTEST:
        misfits = [reason for reason in track.begun if reason]
        if len(misfits) >= FEWEST_FRAMES // 2:
            return f"not rigid: {len(misfits)} beginnings did not fit what followed, the last: {misfits[-1]}"
        return f"seen too short: {len(track.Ts_camera_body)} frames in {time:.1f} s"
    if track.farthest < FARTHEST_STILL:
        return f"moved by {100 * track.farthest:.1f} cm only"
    return ""


def _predicted(T_world_body: NDArray[np.float64], motion: NDArray[np.float64], duration: float) -> NDArray[np.float64]:
    """Pose after some seconds of a motion (6,): velocity of the origin and turning rate, world axes."""
    T = T_world_body.copy()
    T[:3, 3] += motion[:3] * duration
    T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), motion[3:] * duration]))[:3, :3] @ T[:3, :3]
    return T


def _view(observation: Observation, mover: Mover, level: Level, exposure: tuple[float, float]) -> _View | None:
    """The part of the images that shows a body, halved until few enough pixels do; None if it is too small."""
    import cv2

    if np.count_nonzero(mover.mask) < FEWEST_PIXELS:
        return None
    stride = observation.camera.width // mover.mask.shape[1]
    rows, columns = np.flatnonzero(mover.mask.any(axis=1)), np.flatnonzero(mover.mask.any(axis=0))
    low = tuple(
        _around(part, LEAST // stride, size) for part, size in zip((rows, columns), mover.mask.shape, strict=True)
    )
    crop = tuple(slice(part.start * stride, part.stop * stride) for part in low)
    mask = full_size(mover.mask[low], level.depth[low], np.ascontiguousarray(observation.depth[crop])).astype(np.uint8)
    margin = max(2, round(RIM * float(np.sqrt(np.count_nonzero(mask)))))
    mask = cv2.erode(mask, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    pixels = int(np.count_nonzero(mask))
    finest = 0
    while pixels >> (2 * finest) > MOST_PIXELS:
        finest += 1
    y, x = crop[0].start, crop[1].start
    camera = replace(
        observation.camera, cx=observation.camera.cx - x, cy=observation.camera.cy - y,
        width=crop[1].stop - x, height=crop[0].stop - y,
    )  # fmt: skip
    gain, offset = np.float32(exposure[0]), np.float32(exposure[1])
    levels, weights = [], []
    for halvings in range(finest + 2, finest - 1, -1):
        if min(camera.width, camera.height) >> halvings < 16:
            continue
        small = camera.scaled(halvings)
        cut = np.s_[y >> halvings : (y >> halvings) + small.height, x >> halvings : (x >> halvings) + small.width]
        depth, intensity = (np.ascontiguousarray(image[cut]) for image in pyramid(observation, halvings))
        inner = cv2.resize(mask.astype(np.float32), (small.width, small.height), interpolation=cv2.INTER_AREA) > 0.99
        levels.append(Level(small, depth, gain * intensity + offset))
        weights.append((inner & (depth > 0)).astype(np.float32))
    if np.count_nonzero(weights[-1]) < FEWEST_PIXELS:
        return None
    color = exposed_color(np.ascontiguousarray(observation.rgb[crop]), exposure)
    if finest:
        color = np.asarray(cv2.resize(color, weights[-1].shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return _View(levels, weights, color)


def _around(inside: NDArray[np.int64], least: int, size: int) -> slice:
    """Range of at least ``least`` numbers below ``size`` that holds these and one more at each end."""
    start, stop = int(inside[0]) - 1, int(inside[-1]) + 2
    missing = max(0, least - (stop - start))
    start, stop = start - missing // 2, stop + (missing + 1) // 2
    if stop > size:
        start, stop = start - (stop - size), size
    start = max(start, 0)
    return slice(start, min(max(stop, start + least), size))
