"""Set-up of a synthetic recording from names."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError
from dudmap.lab.data import find
from dudmap.lab.synthetic.crowd import crowd_of
from dudmap.lab.synthetic.faults import SensorFaults
from dudmap.lab.synthetic.motion import smooth_step
from dudmap.lab.synthetic.movers import Staging, SyntheticMover, build_movers, rigid
from dudmap.lab.synthetic.paths import FOLLOW, camera_poses
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence
from dudmap.lab.synthetic.rooms import build_scene
from dudmap.lab.synthetic.scene import Material, Scene, box, pose
from dudmap.lab.synthetic.sensors import CAMERAS

Array = NDArray[np.float64]
CAP_DISTANCE = 0.16
"""Distance of the cover from the camera, metres."""


@dataclass(frozen=True)
class Situation:
    """Modification of a sequence: defaults, and shares of the duration.

    Attributes:
        covered: Intervals with a covered camera.
        elsewhere: Intervals with a view of another part.
    """

    movers: tuple[str, ...]
    camera_path: str = "handheld"
    start_dynamic: bool = False
    covered: tuple[tuple[float, float], ...] = ()
    elsewhere: tuple[tuple[float, float], ...] = ()


SITUATIONS: dict[str, Situation] = {
    "people_at_start": Situation(("people",), start_dynamic=True),
    "follow": Situation(("wanderer",), camera_path="follow", start_dynamic=True),
    "blocked": Situation(("person",), covered=((0.40, 0.55),)),
    "kidnapped": Situation((), covered=((0.33, 0.38), (0.60, 0.65)), elsewhere=((0.36, 0.63),)),
    "stops": Situation(("stopping_cart",)),
    "starts": Situation(("starting_cart",)),
    "put_down": Situation(("carried_box",)),
    "taken_away": Situation(("removed_box",)),
}


def carried_elsewhere(Ts: Array, scene: Scene, times: Array, spans: tuple[tuple[float, float], ...]) -> Array:
    """Poses (N, 4, 4) rotated by 150 degrees about the vertical at home in the intervals (shares of the duration)."""
    around = pose(scene.home[:3, 3], yaw=150.0) @ se3.inverse(pose(scene.home[:3, 3]))
    out = Ts.copy()
    for begin, end in spans:
        away = (times >= begin * times[-1]) & (times < end * times[-1])
        out[away] = around @ out[away]
    return out


def cover(
    times: Array, T_world_camera: Callable[[float], Array], spans: tuple[tuple[float, float], ...]
) -> SyntheticMover:
    """Dark sheet nearer than the sensor range, in the intervals (shares of the duration)."""
    sheet = box((0, 0, 0), (0.5, 0.4, 0.01), Material("denim", (2.0, 2.0), tint=(0.35, 0.3, 0.3)))
    duration = float(times[-1])

    def aside(t: float) -> float:
        closed = [
            smooth_step((t - begin * duration) / 0.15 + 1.0) - smooth_step((t - end * duration) / 0.15)
            for begin, end in spans
        ]
        return 1.0 - max(closed)

    def reference(t: float) -> Array:
        return T_world_camera(t) @ pose((0.6 * aside(t), 0.0, CAP_DISTANCE))

    return rigid("cover", [sheet], reference, lambda t: aside(t) < 1.0)


def sequence(
    scene: str = "room",
    movers: Sequence[str] | None = None,
    camera_path: str | Path | None = None,
    frames: int = 120,
    fps: float = 30.0,
    noise: str | None = None,
    speed: float | None = None,
    coverage: float | None = None,
    start_dynamic: bool = False,
    situation: str | None = None,
    seed: int = 0,
    camera: Camera | tuple[int, int] | None = None,
    motion_blur: float | None = None,
    exposure_change: float = 0.0,
    sensor: str | None = None,
    faults: SensorFaults | Mapping[str, Any] | None = None,
) -> SyntheticSequence:
    """Set up a synthetic recording; its frames are rendered on access.

    Args:
        scene: Of ``names()["scenes"]``.
        movers: Names, () for none; None for one person, or the situation's.
        camera_path: Built-in path or TUM file; None for hand-held, or the situation's.
        noise: Of ``names()["noise"]`` (``none`` is exact); None for ``kinect``, or the sensor's.
        speed: Of the movers, m/s; None for natural speeds.
        coverage: Mean share of the image, 0 to 0.95, of a stream of people instead of movers; 0 for none.
        start_dynamic: Movers are in view in the first frame.
        situation: Of ``names()["situations"]``.
        seed: Of path, appearance and noise; equal seeds give equal frames.
        camera: Intrinsics, or width and height, pixels; None for 640x480, with the sensor's view, else 525 px focal
            length.
        motion_blur: Exposure time, share of the frame interval; None for 0, or the sensor's.
        exposure_change: Relative amplitude of a slow oscillation.
        sensor: Of ``names()["sensors"]``: noise, motion blur, faults and view.
        faults: Errors that the sensor's files do not state; a mapping changes the faults of ``sensor``.

    Raises:
        ConfigError: An invalid argument; it names the known values.
    """
    _check("frames", frames, 1, 1_000_000)
    _check("fps", fps, 0.5, 1000)
    model = find(sensor, CAMERAS, "sensor") if sensor is not None else None
    noise = noise or (model.noise if model else "kinect")
    motion_blur = motion_blur if motion_blur is not None else model.motion_blur if model else 0.0
    if not isinstance(faults, SensorFaults):
        faults = replace(model.faults if model else SensorFaults(), **(faults or {}))
    if not isinstance(camera, Camera):
        camera = (model.camera if model else DEFAULT_CAMERA.resized)(*(camera or DEFAULT_CAMERA.shape[::-1]))
    _check("motion_blur", motion_blur, 0, 1)
    _check("exposure_change", exposure_change, 0, 0.9)
    if speed is not None:
        _check("speed", speed, 0.001, 20)
    world = build_scene(scene)
    special = find(situation, SITUATIONS, "situation") if situation is not None else Situation(("person",))
    names = special.movers if movers is None else (movers,) if isinstance(movers, str) else tuple(movers)
    path = special.camera_path if camera_path is None else camera_path
    from_start = start_dynamic or special.start_dynamic
    times = faults.frame_times(frames, fps, seed)
    staging = Staging(world, np.random.default_rng([seed, 4]), speed, float(times[-1]), from_start)
    if coverage is not None and coverage > 0:
        if movers is not None and set(names) - {"person", "people"}:
            raise ConfigError(f"coverage stands for people, but the movers are {', '.join(names)}; drop one of the two")
        names = ("crowd",)
        alone = camera_poses("still" if path == FOLLOW else path, world, times, seed, [])
        actors = crowd_of(coverage, staging, times, alone).movers()
    else:
        names = names if coverage is None else ()
        actors = build_movers(names, staging)
    poses = camera_poses(path, world, times, seed, actors)
    poses = carried_elsewhere(poses, world, times, special.elsewhere)
    poses[:, :3, :3] = [se3.nearest_rotation(R) for R in poses[:, :3, :3]]
    ground_truth = Trajectory(times, poses)
    if special.covered:

        def camera_at(t: float) -> NDArray[np.float64]:
            return ground_truth.interpolate(min(max(t, float(times[0])), float(times[-1])))

        actors.append(cover(times, camera_at, special.covered))
    covered, elsewhere = ([[share * float(times[-1]) for share in span] for span in spans]
                          for spans in (special.covered, special.elsewhere))  # fmt: skip
    parameters: dict[str, object] = {
        "scene": scene, "movers": list(names), "camera_path": str(path), "frames": frames, "fps": fps,
        "sensor_name": sensor, "noise": noise, "speed": speed, "coverage": coverage, "start_dynamic": from_start,
        "situation": situation, "covered_s": covered, "elsewhere_s": elsewhere, "seed": seed,
        "motion_blur": motion_blur, "exposure_change": exposure_change,
    }  # fmt: skip
    return SyntheticSequence(
        world, actors, ground_truth, camera,
        noise=noise, seed=seed, fps=fps, motion_blur=motion_blur, exposure_change=exposure_change, faults=faults,
        parameters=parameters,
    )  # fmt: skip


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name} is {value}; expected a number from {low} to {high}")
