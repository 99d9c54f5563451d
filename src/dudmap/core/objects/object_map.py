"""Map and poses of a tracked object, and the test of its rigidity."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, component_of_vertices, with_faces
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume

EXTENT = 1.0
"""Depth range of an object's window, reference depths: 2.5 m in a room."""
MIN_FRAMES = 10
"""Registered frames that prove rigidity."""
MIN_DURATION = 0.5
"""Seconds that prove rigidity."""
MAX_MISFITS = 0.3
"""Largest share of registered frames that may contradict the map of a rigid object."""
MIN_DISPLACEMENT = 0.03
"""Smallest displacement of a moving object, reference depths."""
MIN_COMPONENT = 0.05
"""Smallest kept component, share of the largest one's vertices."""


@dataclass(frozen=True, eq=False)
class RigidObject:
    """Result of fusing a moving object: its model, or the reason why there is none.

    Attributes:
        rigid: Whether it is one rigid object that has moved.
        mesh: Its shape, metres, object frame, or None. Origin: centre of the box; axes: the world's at first sight.
        trajectory: Its poses T_world_object by the current camera poses, or None.
    """

    id: int
    rigid: bool
    reason: str
    frames: int
    mesh: Mesh | None = None
    trajectory: Trajectory | None = None


class ObjectVolume(TsdfVolume):
    """Map of an object, without carving; its window stays at the object's origin."""

    def __init__(self, camera: Camera, config: VolumeConfig, sensor: SensorConfig, depth_max: float) -> None:
        extent, still = EXTENT * sensor.reference_depth, config.model_copy(update={"carving": False})
        super().__init__(camera, still, sensor, depth_max, extent=extent)
        self._T_object_window = np.eye(4)
        self._T_object_window[2, 3] = -self._reach

    def look_at(self, T_world_camera: NDArray[np.float64]) -> None:
        """Place the window around the origin, independent of the camera pose."""
        del T_world_camera
        super().look_at(self._T_object_window)


@dataclass(eq=False)
class ObjectTrack:
    """State of an object that is registered and fused.

    Attributes:
        T_world_object: (4, 4) current pose.
        T_first: (4, 4) pose at the start of the map.
        first_seen, last_seen: Seconds.
        velocity: (6,) of the origin and of the rotation, m/s and rad/s, world axes.
        Ts_camera_object: Poses (4, 4) of the fused frames, by time.
        points: (n, 3) float32, a sample of the fused surface, object frame, metres.
        max_displacement: Of its surface since the start of the map, metres.
        recent_poses: Times and poses T_world_object of the last ``velocity_window`` seconds.
        restarts: Misfit of each restart; empty for a larger view.
    """

    id: int
    volume: ObjectVolume
    area: float
    T_world_object: NDArray[np.float64]
    T_first: NDArray[np.float64]
    first_seen: float
    last_seen: float
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))
    Ts_camera_object: dict[float, NDArray[np.float64]] = field(default_factory=dict)
    points: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), np.float32))
    misfits: list[str] = field(default_factory=list)
    registrations: int = 0
    max_displacement: float = 0.0
    recent_poses: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)
    restarts: tuple[str, ...] = ()

    def rejection_reason(self, *, final: bool = True) -> str:
        """Reason against rigidity, empty if rigid; missing evidence counts only if ``final``."""
        frames, contradicting = self.registrations, len(self.misfits)
        if frames >= MIN_FRAMES and contradicting > MAX_MISFITS * frames:
            return f"not rigid: {contradicting} of {frames} frames do not fit, the last: {self.misfits[-1]}"
        if not final:
            return ""
        duration = self.last_seen - self.first_seen
        if len(self.Ts_camera_object) < MIN_FRAMES or duration < MIN_DURATION:
            misfits = [reason for reason in self.restarts if reason]
            if len(misfits) >= MIN_FRAMES // 2:
                return f"not rigid: {len(misfits)} maps were contradicted by the next frames, the last: {misfits[-1]}"
            return f"seen too short: {len(self.Ts_camera_object)} frames in {duration:.1f} s"
        if self.max_displacement < MIN_DISPLACEMENT * self.volume.sensor.reference_depth:
            return f"moved by {100 * self.max_displacement:.1f} cm only"
        return ""

    def result(self) -> tuple[RigidObject, dict[float, NDArray[np.float64]]]:
        """Result, and its poses T_camera_object by time; none if not rigid."""
        reason, frames = self.rejection_reason(), len(self.Ts_camera_object)
        if reason:
            return RigidObject(self.id, False, reason, frames), {}
        mesh = _main_components(self.volume.extract_mesh())
        centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        T = np.eye(4)
        T[:3, 3] = centre
        mesh = replace(mesh, vertices=mesh.vertices - centre)
        return RigidObject(self.id, True, "", frames, mesh), {t: pose @ T for t, pose in self.Ts_camera_object.items()}


def _main_components(mesh: Mesh) -> Mesh:
    component = component_of_vertices(mesh)
    counts = np.bincount(component)
    return with_faces(mesh, (counts >= MIN_COMPONENT * counts.max())[component[mesh.faces[:, 0]]])
