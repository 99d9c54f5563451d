"""Things that move: walking people, boxes carried and put down, balls, balloons, creepers, doors."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.synthetic.motion import Track, crossing
from dudmap.synthetic.person import Figure
from dudmap.synthetic.scene import Primitive, Scene, pose

Matrix = NDArray[np.float64]
MOVING_SPEED = 0.01  # m/s; slower than this is at rest


@dataclass(frozen=True, eq=False)
class Mover:
    """Something that moves as one (all limbs of a person are one mover).

    Attributes:
        name: What it is.
        primitives: Its solids, each in the frame of its part.
        parts: Function of time giving T_world_part (P, 4, 4) for every solid.
        reference: Function of time giving T_world_mover (4, 4), the frame whose origin's velocity is the mover's.
        present: Function of time telling whether it exists.
    """

    name: str
    primitives: list[Primitive]
    parts: Callable[[float], Matrix]
    reference: Callable[[float], Matrix]
    present: Callable[[float], bool] = lambda _: True

    def velocity(self, t: float) -> Matrix:
        """Velocity (3,) in m/s, world frame, of the reference frame's origin."""
        h = 0.005
        return (self.reference(t + h)[:3, 3] - self.reference(t - h)[:3, 3]) / (2 * h)

    def top_speed(self, t: float, span: float) -> float:
        """Greatest mean speed in m/s of any of the solids' bounding corners over ``span`` seconds around ``t``."""
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(1, 8, 3)
        bounds = np.array([p.bounds() for p in self.primitives])[:, None, :] * corners
        local = np.array([p.T_body_primitive for p in self.primitives])
        where = []
        for moment in (t - span / 2, t + span / 2):
            Ts = self.parts(moment) @ local
            where.append(bounds @ np.swapaxes(Ts[:, :3, :3], 1, 2) + Ts[:, None, :3, 3])
        return float(np.linalg.norm(where[1] - where[0], axis=2).max() / span)


@dataclass(frozen=True)
class Staging:
    """What a mover needs to know: the scene, chance, the wished speed (None: the mover's own), seconds, and whether
    it is already in view at the first frame."""

    scene: Scene
    rng: np.random.Generator
    speed: float | None
    duration: float
    start_dynamic: bool


def person_on(track: Track, figure: Figure, ground: float, name: str = "person") -> Mover:
    """A person who walks a track."""

    def reference(t: float) -> Matrix:
        position, yaw, _ = track.at(t)
        return pose((*position, ground), float(np.degrees(yaw)))

    return Mover(
        name,
        figure.primitives,
        lambda t: figure.poses(reference(t), track.at(t)[2]),
        reference,
        track.present,
    )


def _offset(line: tuple[tuple[float, float], tuple[float, float]], shift: float, reverse: bool = False):  # noqa: ANN202
    a, b = np.asarray(line[0]), np.asarray(line[1])
    normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    ends = (a + shift * normal, b + shift * normal)
    return ends[::-1] if reverse else ends


def _walker(staging: Staging, number: int, shift: float, reverse: bool, delay: float) -> Mover:
    scene = staging.scene
    speed = staging.speed if staging.speed is not None else 1.2 * scene.mover_scale
    stride = 1.35 * float(np.clip(np.sqrt(speed / scene.mover_scale / 1.2), 0.35, 1.2))
    track = crossing(
        _offset(scene.walk_line, shift * scene.mover_scale, reverse),
        speed,
        staging.duration,
        enter=1.0 + delay,
        start_inside=staging.start_dynamic and delay == 0.0,
        entry_speed=1.2 * scene.mover_scale,
    )
    return person_on(track, Figure(staging.rng, number, scene.mover_scale, stride), scene.ground)


def _person(staging: Staging) -> list[Mover]:
    return [_walker(staging, 0, 0.0, False, 0.0)]


def _people(staging: Staging) -> list[Mover]:
    late = 0.0 if staging.start_dynamic else 0.9
    return [_walker(staging, 1, 0.0, False, 0.0), _walker(staging, 2, 0.3, True, late)]


MOVERS: dict[str, Callable[[Staging], list[Mover]]] = {
    "person": _person,
    "people": _people,
}


def build_movers(names: tuple[str, ...], staging: Staging) -> list[Mover]:
    """Movers by name.

    Raises:
        ConfigError: A name is unknown.
    """
    movers: list[Mover] = []
    for name in names:
        if name not in MOVERS:
            raise ConfigError(f"unknown mover {name!r}; known movers: {', '.join(MOVERS)}")
        movers += MOVERS[name](staging)
    return movers
