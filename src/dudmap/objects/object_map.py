"""A moving body while it is followed: its map, its poses, and whether they prove it rigid."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.geometry.camera import Camera
from dudmap.geometry.mesh import Mesh
from dudmap.geometry.trajectory import Trajectory
from dudmap.mapping.volume import TsdfVolume

EXTENT = 1.0
"""The window of a body's map is that of a camera with readings up to this, metres: a cube of about 2.5 m."""
FEWEST_FRAMES = 10
"""Registrations that prove a body rigid."""
SHORTEST = 0.5
"""Time that proves a body rigid, seconds."""
FAILED = 0.3
"""Largest share of frames that do not fit a rigid body."""
FARTHEST_STILL = 0.03
"""What has not moved farther than this is no moving body, metres."""
FLECK = 0.05
"""Segmentation of a mesh that have a smaller share of the largest piece's vertices than this are left out."""


@dataclass(frozen=True, eq=False)
class RigidObject:
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


class ObjectVolume(TsdfVolume):
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


@dataclass(eq=False)
class ObjectTrack:
    """A body that is being registered.

    Attributes:
        id: The mover's number.
        volume: Its map.
        area: Visible surface when that was begun, square metres.
        T_world_body: (4, 4) its pose now, and ``T_first`` when its map was begun.
        first_seen, last_seen: Seconds.
        motion: (6,) m/s and rad/s, world axes.
        Ts_camera_body: Poses (4, 4) of the frames that were fused, by time.
        points: (n, 3) float32 some of the surface that was fused, body frame, metres.
        misfits: What each frame that did not fit was refused for.
        judged: Shares of the surface that was seen through, and of the readings that were off it, per frame.
        farthest: Farthest way of its points from where they began, metres.
        recent: Times and poses T_world_body of the last while.
        begun: Misfit that the map was begun anew for, each time; empty where more came into view.
    """

    id: int
    volume: ObjectVolume
    area: float
    T_world_body: NDArray[np.float64]
    T_first: NDArray[np.float64]
    first_seen: float
    last_seen: float
    motion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))
    Ts_camera_body: dict[float, NDArray[np.float64]] = field(default_factory=dict)
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), np.float32))
    misfits: list[str] = field(default_factory=list)
    judged: list[tuple[float, float]] = field(default_factory=list)
    farthest: float = 0.0
    recent: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)
    begun: tuple[str, ...] = ()

    def why(self, *, final: bool = True) -> str:
        """Why it is not rigid or not known to be; empty if it is, or before the end if nothing speaks against it."""
        judged, bad = len(self.judged), len(self.misfits)
        if judged >= FEWEST_FRAMES and bad > FAILED * judged:
            return f"not rigid: {bad} of {judged} frames do not fit, the last: {self.misfits[-1]}"
        if not final:
            return ""
        time = self.last_seen - self.first_seen
        if len(self.Ts_camera_body) < FEWEST_FRAMES or time < SHORTEST:
            misfits = [reason for reason in self.begun if reason]
            if len(misfits) >= FEWEST_FRAMES // 2:
                return f"not rigid: {len(misfits)} beginnings did not fit what followed, the last: {misfits[-1]}"
            return f"seen too short: {len(self.Ts_camera_body)} frames in {time:.1f} s"
        if self.farthest < FARTHEST_STILL:
            return f"moved by {100 * self.farthest:.1f} cm only"
        return ""

    def finished(self) -> tuple[RigidObject, dict[float, NDArray[np.float64]]]:
        """What came of a body, and its poses T_camera_body by time."""
        why, frames = self.why(), len(self.Ts_camera_body)
        if why:
            return RigidObject(self.id, False, why, frames), {}
        mesh = _without_flecks(self.volume.extract_mesh())
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        T = np.eye(4)
        T[:3, 3] = middle
        mesh = replace(mesh, vertices=mesh.vertices - middle)
        return RigidObject(self.id, True, "", frames, mesh), {t: pose @ T for t, pose in self.Ts_camera_body.items()}


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
