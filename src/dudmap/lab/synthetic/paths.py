"""Camera paths: built-in, or recorded and placed in a scene. Unknown or unfit ones raise a ``ConfigError``."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.lab.synthetic.movers import SyntheticMover
from dudmap.lab.synthetic.scene import Scene, look_at

Array = NDArray[np.float64]


def _wander(rng: np.random.Generator, times: Array, speed: float, quick: float = 1.0) -> Array:
    dense = np.arange(0.0, 30.0, 0.02)
    frequency = quick * rng.uniform([0.08, 0.18, 0.3], [0.16, 0.28, 0.45], (3, 3))
    phase = rng.uniform(0, 2 * np.pi, (3, 3))
    weight = np.array([1.0, 0.6, 0.3]) * rng.uniform(0.7, 1.3, (3, 3)) * np.array([[1.0], [1.0], [0.6]])

    def curve(t: Array) -> Array:
        return (weight * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=2)

    mean_speed = np.linalg.norm(np.diff(curve(dense), axis=0), axis=1).mean() / 0.02
    return curve(times) * (speed / mean_speed)


def _tremor(rng: np.random.Generator, times: Array, size: float) -> Array:
    """Hand tremor (N, 3): sines between 4 and 11 Hz with the given root mean square per axis."""
    frequency = rng.uniform(4.0, 11.0, (3, 4))
    phase = rng.uniform(0, 2 * np.pi, (3, 4))
    return size * np.sin(2 * np.pi * frequency * times[:, None, None] + phase).sum(axis=2) / np.sqrt(2.0)


def _aimed(positions: Array, targets: Array) -> Array:
    targets = np.broadcast_to(targets, positions.shape)
    return np.stack([look_at(eye, target) for eye, target in zip(positions, targets, strict=True)])


def _shaken(Ts: Array, rotations: Array) -> Array:
    out = Ts.copy()
    for T, vector in zip(out, rotations, strict=True):
        T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), vector]))[:3, :3]
    return out


def _within(scene: Scene, shift: Array) -> Array:
    low, high = (np.asarray(corner) - scene.home[:3, 3] for corner in scene.space)
    return np.where(shift > 0, high * np.tanh(shift / high), low * np.tanh(shift / low))


def handheld(
    scene: Scene,
    rng: np.random.Generator,
    times: Array,
    speed: float = 0.2,
    turn: float = 10.0,
    tremor: float = 1.0,
    quick: float = 1.0,
) -> Array:
    """Hand-held camera aimed at the target: m/s (at life size), degrees/s."""
    shift = _within(scene, _wander(rng, times, speed * max(scene.mover_scale, 0.3), quick))
    shift += _tremor(rng, times, 0.0005 * tremor * scene.mover_scale)
    Ts = _aimed(scene.home[:3, 3] + shift, np.asarray(scene.target))
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    own = np.mean([se3.rotation_angle(se3.inverse(a) @ b) for a, b in pairwise(Ts)] or [0.0]) / step
    left = np.sqrt(max(np.radians(turn) ** 2 - own**2, np.radians(0.35 * turn) ** 2))
    swing = _wander(rng, times, left, quick) * (0.7, 1.0, 0.5)
    return _shaken(Ts, swing + _tremor(rng, times, np.radians(0.04) * tremor))


def _turned(offset: Array, angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], np.full_like(c, offset[2])], axis=1)


def _at_target(scene: Scene, rng: np.random.Generator, times: Array, eyes: Array, tremor_deg: float = 0.04) -> Array:
    Ts = _aimed(eyes, np.asarray(scene.target))
    return _shaken(Ts, _tremor(rng, times, np.radians(tremor_deg)))


def _turning(scene: Scene, rng: np.random.Generator, times: Array, angle: Array, speed: float) -> Array:
    aims = _turned(scene.target - scene.home[:3, 3], angle)
    eyes = scene.home[:3, 3] + _within(scene, _wander(rng, times, speed * scene.mover_scale))
    return _shaken(_aimed(eyes, eyes + aims), _tremor(rng, times, np.radians(0.04)))


def _orbit(scene: Scene, rng: np.random.Generator, times: Array) -> Array:
    home, target = scene.home[:3, 3], np.asarray(scene.target)
    around = _turned(home - target, np.radians(30.0) * np.sin(2 * np.pi * times / 20.0))
    return _at_target(scene, rng, times, home + _within(scene, target + around - home))


def _dolly(scene: Scene, rng: np.random.Generator, times: Array) -> Array:
    ahead = scene.home[:3, 2] * scene.mover_scale * 0.5 * np.sin(0.6 * times)[:, None]
    eyes = scene.home[:3, 3] + _within(scene, ahead + _wander(rng, times, 0.05 * scene.mover_scale))
    return _at_target(scene, rng, times, eyes, 0.06)


def follow(scene: Scene, rng: np.random.Generator, times: Array, mover: SyntheticMover) -> Array:
    """Camera that follows a mover with a hand's delay, else aims at the target."""

    def aim(t: float) -> Array:
        if not mover.present(t):
            return np.asarray(scene.target)
        return mover.reference(t)[:3, 3] + (0, 0, 1.05 * scene.mover_scale)

    weights = np.exp(-np.arange(0.0, 1.2, 0.05) / 0.3)
    aims = np.stack([sum(w * aim(t - 0.05 * k) for k, w in enumerate(weights)) / weights.sum() for t in times])
    eyes = scene.home[:3, 3] + _within(scene, _wander(rng, times, 0.12 * scene.mover_scale))
    return _shaken(_aimed(eyes, aims), _tremor(rng, times, np.radians(0.05)))


PATHS: dict[str, Callable[[Scene, np.random.Generator, Array], Array]] = {
    "handheld": handheld,
    "slow": lambda scene, rng, times: handheld(scene, rng, times, 0.06, 3.0, 0.7),
    "fast": lambda scene, rng, times: handheld(scene, rng, times, 0.6, 45.0, 1.5, 2.2),
    "still": lambda scene, rng, times: np.tile(scene.home, (len(times), 1, 1)),
    # 40 degrees to either side about the vertical, at 20 degrees per second on average
    "pan": lambda scene, rng, t: _turning(scene, rng, t, np.radians(40.0) * np.sin(2 * np.pi * t / 8.0), 0.03),
    "orbit": _orbit,
    "dolly": _dolly,
    # 405 degrees about the vertical, so that the last frames show the first view again
    "round": lambda scene, rng, t: _turning(scene, rng, t, np.radians(405.0) * (t / max(t[-1], 1e-9)), 0.1),
}
FOLLOW = "follow"


def camera_poses(path: str | Path, scene: Scene, times: Array, seed: int, movers: list[SyntheticMover]) -> Array:
    """Poses (N, 4, 4) of a built-in path or a file at ``times`` (N,), from 0."""
    rng = np.random.default_rng([seed, 2])
    if str(path) == FOLLOW:
        if not movers:
            raise ConfigError("camera path 'follow' needs a mover to follow; name one")
        return follow(scene, rng, times, movers[0])
    if str(path) in PATHS:
        return PATHS[str(path)](scene, rng, times)
    if not Path(path).is_file():
        known = ", ".join([*PATHS, FOLLOW])
        raise ConfigError(f"camera path {str(path)!r} is neither a trajectory file nor one of {known}")
    return placed(Trajectory.load(path), scene, times, str(path))


def placed(trajectory: Trajectory, scene: Scene, times: Array, name: str) -> Array:
    """Recorded trajectory, resampled at ``times`` and placed in the scene: mean orientation of home, centre as near to
    home as free space permits."""
    start, end = trajectory.timestamps[0], trajectory.timestamps[-1]
    if times[-1] > end - start + 1e-6:
        raise ConfigError(
            f"{name} lasts {end - start:.2f} s, but the frames need {times[-1]:.2f} s; ask for fewer frames"
        )
    try:
        Ts = np.stack([trajectory.interpolate(min(start + t, end)) for t in times])
    except DatasetError as error:
        raise ConfigError(f"{name}: {error}") from None
    mean = np.eye(4)
    mean[:3, :3] = se3.nearest_rotation(Ts[:, :3, :3].mean(axis=0))
    mean[:3, 3] = (Ts[:, :3, 3].min(axis=0) + Ts[:, :3, 3].max(axis=0)) / 2
    Ts = scene.home @ se3.inverse(mean) @ Ts
    low, high = (np.asarray(corner) for corner in scene.space)
    first, last = Ts[:, :3, 3].min(axis=0), Ts[:, :3, 3].max(axis=0)
    size = last - first
    margin = 0.25 * min(scene.mover_scale, 1.0)
    if np.all(size <= high - low):
        nearest = np.clip(0.0, low - first, high - last)  # smallest shift into the free space
        steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3), axis=-1).reshape(-1, 3)
        shifts = np.clip(nearest + steps * (high - low) / 2, low - first, high - last)
        for shift in shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")]:
            if scene.clearance(Ts[::5, :3, 3] + shift).min() >= margin:
                Ts[:, :3, 3] += shift
                return Ts
    spans, space = (" x ".join(f"{x:.2f}" for x in numbers) for numbers in (size, high - low))
    raise ConfigError(
        f"{name} spans {spans} m over these frames, but scene {scene.name!r} has only {space} m of free space; "
        "take a larger scene or fewer frames"
    )
