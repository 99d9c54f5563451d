"""Camera paths: built-in ones, and recorded trajectories placed rigidly into a scene."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap import se3
from dudmap.errors import ConfigError
from dudmap.synthetic.scene import Scene, look_at
from dudmap.trajectory import Trajectory

Poses = NDArray[np.float64]


def _wander(rng: np.random.Generator, times: NDArray[np.float64], speed: float) -> NDArray[np.float64]:
    """Smooth zero-mean wandering (N, 3): three slow sines per axis, mean speed ``speed`` in units per second."""
    dense = np.arange(0.0, 30.0, 0.02)
    frequency = rng.uniform([0.08, 0.18, 0.3], [0.16, 0.28, 0.45], (3, 3))
    phase = rng.uniform(0, 2 * np.pi, (3, 3))
    weight = np.array([1.0, 0.6, 0.3]) * rng.uniform(0.7, 1.3, (3, 3)) * np.array([[1.0], [1.0], [0.6]])

    def curve(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return (weight * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=2)

    mean_speed = np.linalg.norm(np.diff(curve(dense), axis=0), axis=1).mean() / 0.02
    return curve(times) * (speed / mean_speed)


def _tremor(rng: np.random.Generator, times: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Trembling of a hand (N, 3): sines between 4 and 11 Hz of the given root mean square."""
    frequency = rng.uniform(4.0, 11.0, (3, 4))
    phase = rng.uniform(0, 2 * np.pi, (3, 4))
    return size * np.sqrt(0.5) * np.sin(2 * np.pi * frequency * times[:, None, None] + phase).sum(axis=2) / np.sqrt(2.0)


def handheld(
    scene: Scene,
    rng: np.random.Generator,
    times: NDArray[np.float64],
    speed: float = 0.2,
    turn: float = 10.0,
    tremor: float = 1.0,
) -> Poses:
    """A person holds the camera towards the scene's target: mean speed in m/s, mean turn rate in degrees per second."""
    low, high = (np.asarray(corner) for corner in scene.space)
    shift = _wander(rng, times, speed * scene.mover_scale)
    room = np.minimum(high - scene.home[:3, 3], scene.home[:3, 3] - low)
    shift = room * np.tanh(shift / room)  # stays inside the free space
    shift += _tremor(rng, times, 0.0006 * tremor * scene.mover_scale)
    aim = _wander(rng, times, 1.0)
    Ts = np.stack([look_at(scene.home[:3, 3] + offset, scene.target) for offset in shift])
    own = np.mean([se3.rotation_angle(se3.inverse(a) @ b) for a, b in pairwise(Ts)] or [0.0])
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    left = np.sqrt(max(np.radians(turn) ** 2 - (own / step) ** 2, np.radians(0.35 * turn) ** 2))
    shake = _tremor(rng, times, np.radians(0.07) * tremor)
    for T, swing, tremble in zip(Ts, aim * left * (0.7, 1.0, 0.5), shake, strict=True):
        T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), swing + tremble]))[:3, :3]
    return Ts


def _still(scene: Scene, _: np.random.Generator, times: NDArray[np.float64]) -> Poses:
    return np.tile(scene.home, (len(times), 1, 1))


PATHS: dict[str, Callable[[Scene, np.random.Generator, NDArray[np.float64]], Poses]] = {
    "handheld": handheld,
    "slow": lambda scene, rng, times: handheld(scene, rng, times, 0.06, 3.0, 0.7),
    "fast": lambda scene, rng, times: handheld(scene, rng, times, 0.6, 45.0, 1.5),
    "still": _still,
}


def camera_poses(path: str | Path, scene: Scene, times: NDArray[np.float64], seed: int) -> Poses:
    """Poses Ts_world_camera (N, 4, 4) of a built-in path or of a trajectory file, at ``times`` from 0 on.

    Raises:
        ConfigError: There is neither a path nor a file of this name, or the file does not fit.
    """
    if str(path) in PATHS:
        return PATHS[str(path)](scene, np.random.default_rng([seed, 2]), times)
    if not Path(path).is_file():
        raise ConfigError(f"camera path {str(path)!r} is neither a trajectory file nor one of {', '.join(PATHS)}")
    return placed(Trajectory.load(path), scene, times, str(path))


def placed(trajectory: Trajectory, scene: Scene, times: NDArray[np.float64], name: str) -> Poses:
    """A recorded trajectory, resampled and moved as a whole so that its mean pose is the scene's home."""
    span = trajectory.timestamps[-1] - trajectory.timestamps[0]
    if times[-1] > span + 1e-6:
        raise ConfigError(f"{name} lasts {span:.2f} s, but {times[-1]:.2f} s are needed; ask for fewer frames")
    start = trajectory.timestamps[0]
    Ts = np.stack([trajectory.interpolate(min(start + t, trajectory.timestamps[-1])) for t in times])
    mean = np.eye(4)
    mean[:3, :3] = se3.nearest_rotation(Ts[:, :3, :3].mean(axis=0))
    mean[:3, 3] = (Ts[:, :3, 3].min(axis=0) + Ts[:, :3, 3].max(axis=0)) / 2
    return scene.home @ se3.inverse(mean) @ Ts
