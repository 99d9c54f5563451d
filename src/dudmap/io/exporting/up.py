"""The upward direction in the world of a run: given, measured, or guessed from the floor."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, MapError
from dudmap.io.exporting.gravity import FLOOR_SHARE, Floor, fitted, floor_height, level_normal, unit, z_up
from dudmap.io.exporting.mesh_editing import edited, face_vectors, rotated
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.sequences.gravity import MeasuredUp, mean_direction

CONTRADICTS = 20.0
"""Angle beyond which two up directions contradict each other, degrees: between ramps and stairs."""
ACCURACY = 5.0
"""A floor within this angle of measured gravity is level, degrees: IMU mounting and map drift."""
LEVEL = np.cos(np.radians(15))
"""A surface faces a direction within 15 degrees (cosine)."""
UPSIDE_DOWN = 2.0
"""Ratio of surface facing down to up of a map that may be upside down."""
TURNED, STEADY = 0.64, 0.9
"""Singular values of the mean rotation: the second is below ``TURNED`` (sin(x) / x at a quarter turn) after half a
turn, the first above ``STEADY`` when nodding by less than 25 degrees."""
ASSUMED = "assumed: the camera is upright"


class Up(NamedTuple):
    """The direction against gravity in the world of a run.

    Attributes:
        direction: (3,) unit vector.
        source: ``given``, ``gravity`` (measured), ``floor`` (level surface below an upright camera) or ``cameras``
            (mean upper edge of the images).
        sigma_deg: Standard deviation, degrees; None for a given direction.
        evidence: Words for the source.
        contradiction: Sentence against it; empty without one.
    """

    direction: NDArray[np.float64]
    source: str
    sigma_deg: float | None
    evidence: str
    contradiction: str = ""
    floor: Floor | None = None

    def metrics(self, measured: MeasuredUp | None) -> dict[str, Any]:
        """The entry ``up`` of metrics.json, with the measured gravity."""
        gravity = None if measured is None else measured._asdict() | {"direction": measured.direction.tolist()}
        height = None if self.floor is None else round(self.floor.height, 4)
        sigma = None if self.sigma_deg is None else round(self.sigma_deg, 2)
        return {
            "direction": self.direction.round(6).tolist(), "source": self.source, "sigma_deg": sigma,
            "floor_height": height, "evidence": self.evidence, "contradiction": self.contradiction or None,
            "gravity": gravity,
        }  # fmt: skip


def up_of(run: RunContent, options: ExportOptions) -> NDArray[np.float64]:
    """Unit vector (3,) against gravity."""
    return run_up(run, options).direction


def find_floor(run: RunContent, options: ExportOptions) -> Floor:
    """The floor of a map; ``ConfigError`` if there is none, or it may be the ceiling."""
    return checked_floor(run, run_up(run, options))


def checked_floor(run: RunContent, up: Up) -> Floor:
    """The floor below a direction; ``ConfigError`` if the direction is a contradicted guess."""
    if up.contradiction and up.source not in ("given", "gravity"):
        raise ConfigError(up.contradiction)
    if up.floor is None:
        raise ConfigError(f"no floor was found in the mesh of {run.folder}; give the direction against gravity by --up")
    return up.floor


def upright(run: RunContent, options: ExportOptions) -> tuple[RunContent, ExportOptions]:
    """Surface and trajectory with z up from the floor, and the remaining options."""
    T = z_up(find_floor(run, options))
    mesh = rotated(edited(run.surface, options), T[:3, :3])
    mesh = replace(mesh, vertices=(mesh.vertices + T[:3, 3]).astype(np.float32))
    poses = Trajectory(run.trajectory.timestamps, T @ run.trajectory.Ts_world_camera)
    turned = RunContent(run.folder)
    vars(turned).update(mesh=mesh, trajectory=poses)
    return turned, replace(options, max_triangles=None, crop=None, drop_pieces_below=0.0, fill_holes=None)


def run_up(run: RunContent, options: ExportOptions) -> Up:
    """The direction against gravity of a finished run."""
    return find_up(run.surface, run.trajectory, measured_in(run), options.up)


def measured_in(run: RunContent) -> MeasuredUp | None:
    """Measured direction against gravity, from metrics.json; None without one."""
    found = (run.metrics.get("up") or {}).get("gravity")
    if found is None:
        return None
    return MeasuredUp(unit(found["direction"]), float(found["sigma_deg"]), found["source"], int(found["readings"]))


def find_up(
    mesh: Mesh | None,
    poses: Trajectory,
    measured: MeasuredUp | None = None,
    given: tuple[float, float, float] | None = None,
) -> Up:
    """The direction against gravity, by the best evidence.

    Args:
        mesh: The surface, if any.
        poses: Of the cameras, in the world of the mesh.

    Raises:
        ConfigError: The given direction has no length.
        MapError: There is no pose.
    """
    if given is not None:
        direction = unit(given)
        height = None if mesh is None else floor_height(mesh, direction)
        said = _against(measured, direction, "the given direction")
        return Up(direction, "given", None, "given", said, None if height is None else Floor(direction, height))
    if not len(poses):
        raise MapError("a direction against gravity needs poses, and there are none")
    held, spread = mean_direction(-poses.Ts_world_camera[:, :3, 1])
    held = -poses.Ts_world_camera[0, :3, 1] if held is None else held
    guess = None if mesh is None else _floor(mesh, held)
    if measured is not None and measured.sigma_deg <= CONTRADICTS:
        return _by_gravity(mesh, measured, guess)
    if guess is None:
        found = Up(held, "cameras", spread, f"mean direction of the images' upper edge; {ASSUMED}")
    else:
        floor, sigma = guess
        found = Up(floor.up, "floor", sigma, f"the most frequent level surface; {ASSUMED}", "", floor)
    said = _contradiction(mesh, poses, held, found)
    if measured is not None and not said:
        said = (
            f"gravity of {measured.source} spreads by {measured.sigma_deg:.0f} degrees among the poses: not used; if "
            f"the camera was upright, it is --up {_numbers(found.direction)}"
        )
    return found._replace(contradiction=said)


def _by_gravity(mesh: Mesh | None, measured: MeasuredUp, guess: tuple[Floor, float] | None) -> Up:
    limit = max(ACCURACY, 3 * measured.sigma_deg)
    level = None if mesh is None else _floor(mesh, measured.direction, limit)
    evidence = f"gravity of {measured.source}, {measured.readings} readings"
    said = (
        "" if guess is None else _against(measured, guess[0].up, "the level surface that an upright camera has below")
    )
    if level is not None and (angle := _angle(level[0].up, measured.direction)) <= limit:
        evidence += f"; the floor is {angle:.1f} degrees off"
        return Up(level[0].up, "gravity", level[1], evidence, said, level[0])
    height = None if mesh is None else floor_height(mesh, measured.direction)
    floor = None if height is None else Floor(measured.direction, height)
    return Up(measured.direction, "gravity", measured.sigma_deg, evidence, said, floor)


def _floor(mesh: Mesh, near: NDArray[np.float64], limit: float | None = None) -> tuple[Floor, float] | None:
    level = level_normal(mesh, near) if limit is None else level_normal(mesh, near, float(np.cos(np.radians(limit))))
    height = None if level is None else floor_height(mesh, level)
    if level is None or height is None:
        return None
    floor = fitted(mesh, Floor(level, height))
    return floor, _unevenness(mesh, floor)


def _unevenness(mesh: Mesh, floor: Floor) -> float:
    facing = (mesh.normals @ floor.up > LEVEL) & (np.abs(mesh.vertices @ floor.up - floor.height) < 0.05)
    points = mesh.vertices[facing].astype(np.float64)
    if len(points) < 10:
        return CONTRADICTS
    across, shorter = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0))[:2]
    return float(np.degrees(np.arctan2(across, shorter)))


def _against(measured: MeasuredUp | None, direction: NDArray[np.float64], name: str) -> str:
    if measured is None or (angle := _angle(measured.direction, direction)) <= CONTRADICTS:
        return ""
    return f"up: {name} is {angle:.0f} degrees off the gravity of {measured.source}"


def _facing(mesh: Mesh, direction: NDArray[np.float64]) -> float:
    vectors = face_vectors(mesh)
    areas = np.linalg.norm(vectors, axis=1)
    return float(areas[vectors @ direction > LEVEL * areas].sum())


def _contradiction(mesh: Mesh | None, poses: Trajectory, held: NDArray[np.float64], guess: Up) -> str:
    if mesh is not None:
        upward = _facing(mesh, guess.direction)
        below = _floor(mesh, -held)
        if below is not None and (downward := _facing(mesh, below[0].up)) > UPSIDE_DOWN * upward:
            return (
                f"the map may be upside down: if the camera was upright, {upward:.2g} m2 of level surface face up and "
                f"{downward:.2g} m2 down; the other way round it is --up {_numbers(below[0].up)}"
            )
        side = mean_direction(poses.Ts_world_camera[:, :3, 0])[0]
        sides = [] if side is None or guess.floor is not None else [_floor(mesh, way * side) for way in (1, -1)]
        areas = [(_facing(mesh, side[0].up), *side[0].up) for side in sides if side is not None]
        if areas and max(areas)[0] > FLOOR_SHARE * float(np.linalg.norm(face_vectors(mesh), axis=1).sum()):
            return (
                "the camera may have been rolled by 90 degrees: no level surface faces up if it was upright, but "
                f"{max(areas)[0]:.2g} m2 face the side of its images; that side is --up {_numbers(max(areas)[1:])}"
            )
    axes, sizes, _ = np.linalg.svd(poses.Ts_world_camera[:, :3, :3].mean(axis=0))
    axis = axes[:, 0]
    if (
        sizes[1] < TURNED
        and sizes[0] > STEADY
        and (angle := min(_angle(axis, guess.direction), _angle(-axis, guess.direction))) > 45
    ):
        return (
            f"the camera may have been rolled: its rotation axis is {angle:.0f} degrees off the vertical of an upright "
            f"camera; the axis is --up {_numbers(axis)} or {_numbers(-axis)}"
        )
    return ""


def _numbers(direction: Iterable[float]) -> str:
    return ",".join(f"{number:.3f}" for number in direction)


def _angle(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))
