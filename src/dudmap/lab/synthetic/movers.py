"""Moving objects: walking people, carried boxes, balls, balloons, carts and doors."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.lab.data import find
from dudmap.lab.synthetic.motion import Figure, FloorPath, crossing, smooth_step
from dudmap.lab.synthetic.rooms import SOLIDS, built
from dudmap.lab.synthetic.scene import Material, Primitive, Scene, pose

Matrix = NDArray[np.float64]
MOVING_SPEED = 0.01
"""Speed of rest, m/s."""


@dataclass(frozen=True, eq=False)
class SyntheticMover:
    """A moving object with all limbs.

    Attributes:
        name: Kind of object.
        primitives: Its solids, each in the frame of its part.
        parts: T_world_part (P, 4, 4) of every solid at a time.
        reference: T_world_mover (4, 4) at a time; its origin has the mover's velocity.
    """

    name: str
    primitives: list[Primitive]
    parts: Callable[[float], Matrix]
    reference: Callable[[float], Matrix]
    present: Callable[[float], bool] = lambda _: True
    settles: bool = True

    def velocity(self, t: float) -> Matrix:
        """Velocity (3,) of the reference origin, m/s, world frame."""
        h = 0.005
        return (self.reference(t + h)[:3, 3] - self.reference(t - h)[:3, 3]) / (2 * h)

    def top_speed(self, t: float, span: float) -> float:
        """Largest mean speed of a bounding-box corner over ``span`` seconds around ``t``, m/s."""
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(1, 8, 3)
        bounds = np.array([p.bounds() for p in self.primitives])[:, None, :] * corners
        local = np.array([p.T_body_primitive for p in self.primitives])
        where = []
        for moment in (t - span / 2, t + span / 2):
            Ts = self.parts(moment) @ local
            where.append(bounds @ np.swapaxes(Ts[:, :3, :3], 1, 2) + Ts[:, None, :3, 3])
        return float(np.linalg.norm(where[1] - where[0], axis=2).max() / span)


def placed(movers: list[SyntheticMover], t: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Poses (P, 4, 4) of all solids at a time, and which exist (P,)."""
    Ts, present = [np.empty((0, 4, 4))], []
    for mover in movers:
        count, exists = len(mover.primitives), mover.present(t)
        local = np.array([primitive.T_body_primitive for primitive in mover.primitives])
        Ts.append(mover.parts(t) @ local if exists else np.tile(np.eye(4), (count, 1, 1)))
        present += [exists] * count
    return np.concatenate(Ts), np.array(present, dtype=bool)


@dataclass(frozen=True)
class Staging:
    """Conditions under which movers are built.

    Attributes:
        speed: m/s; None for natural speeds.
        duration: Seconds.
        start_dynamic: In view and moving in the first frame.
    """

    scene: Scene
    rng: np.random.Generator
    speed: float | None
    duration: float
    start_dynamic: bool

    def pace(self, natural: float) -> float:
        """Requested speed, else ``natural`` (m/s at life size) scaled."""
        return self.speed if self.speed is not None else natural * self.scene.mover_scale

    def crossing(self, speed: float, entry_speed: float) -> FloorPath:
        """Path along the scene's walk line, m/s in the middle and at the ends."""
        line, inside = self.scene.walk_line, self.start_dynamic
        return crossing(line, speed, self.duration, start_inside=inside, entry_speed=entry_speed)


def person_on(
    path: FloorPath, figure: Figure, ground: float, carrying: Callable[[float], float] = lambda _: 0.0
) -> SyntheticMover:
    """Person walking along a path; ``carrying``: lift of the arms in [0, 1] at a time."""

    def reference(t: float) -> Matrix:
        return path.pose(t, ground)

    def parts(t: float) -> Matrix:
        return figure.poses(reference(t), path.at(t)[2], carrying(t))

    return SyntheticMover("person", figure.primitives, parts, reference, path.present, settles=False)


def rigid(
    name: str,
    primitives: list[Primitive],
    reference: Callable[[float], Matrix],
    present: Callable[[float], bool] = lambda _: True,
) -> SyntheticMover:
    """Rigid mover."""
    return SyntheticMover(
        name, primitives, lambda t: np.tile(reference(t), (len(primitives), 1, 1)), reference, present
    )


def _figure(staging: Staging, outfit: int, speed: float) -> Figure:
    size = staging.scene.mover_scale
    return Figure(staging.rng, outfit, size, 1.35 * float(np.clip(np.sqrt(speed / size / 1.2), 0.35, 1.2)))


def _walker(staging: Staging, outfit: int, shift: float, reverse: bool, delay: float) -> SyntheticMover:
    scene, speed, size = staging.scene, staging.pace(1.2), staging.scene.mover_scale
    a, b = np.asarray(scene.walk_line[0]), np.asarray(scene.walk_line[1])
    aside = shift * size * (np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a))
    first, last = (a + aside).tolist(), (b + aside).tolist()
    line = (last, first) if reverse else (first, last)
    path = crossing(
        line, speed, staging.duration, enter=1.0 + delay, start_inside=staging.start_dynamic, entry_speed=1.2 * size
    )
    return person_on(path, _figure(staging, outfit, speed), scene.ground)


def _people(staging: Staging) -> list[SyntheticMover]:
    return [_walker(staging, 1, 0.0, False, 0.0), _walker(staging, 2, 0.3, True, 0.6)]


def _wanderer(staging: Staging) -> list[SyntheticMover]:
    """Person who walks in circles and never leaves the view."""
    scene, speed = staging.scene, staging.pace(0.6)
    a, b = np.asarray(scene.walk_line[0]), np.asarray(scene.walk_line[1])
    along, middle = (b - a) / 2, (a + b) / 2
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    angles = np.arange(0.0, 2 * np.pi * 400, 0.1) + 2.2
    loop = (
        middle
        + 0.5 * np.sin(angles)[:, None] * along
        + 0.22 * scene.mover_scale * np.cos(angles)[:, None] * across
    )  # fmt: skip
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(loop, axis=0), axis=1))])
    times = walked / speed
    keep = times <= staging.duration + 2.0
    path = FloorPath(list(times[keep] - 1.5), loop[keep].tolist(), smooth=0.1)
    return [person_on(path, _figure(staging, 3, speed), scene.ground)]


def _solids(name: str, size: float) -> list[Primitive]:
    materials = {key: Material(**given) for key, given in SOLIDS["materials"].items()}
    return [solid.scaled(size) for solid in built(SOLIDS["movers"][name], materials)]


def _carrier(staging: Staging, put_down: bool) -> list[SyntheticMover]:
    """Person who brings a box and leaves it, or who takes one away."""
    scene, speed, size = staging.scene, staging.pace(1.0), staging.scene.mover_scale
    a, b = np.asarray(scene.walk_line[0]), np.asarray(scene.walk_line[1])
    spot = scene.rest[:2, 3]
    foot = a + (b - a) * float((spot - a) @ (b - a) / ((b - a) @ (b - a)))
    towards = (spot - foot) / np.linalg.norm(spot - foot)
    stand = spot - 0.52 * size * towards
    way = [a, foot, stand, stand, foot, b]
    if staging.start_dynamic:
        way[0] = a + 0.35 * (b - a)
    steps = [float(np.linalg.norm(q - p)) / speed for p, q in pairwise(way)]
    steps[2] = 1.6
    times = np.cumsum([0.0, *steps])
    path = FloorPath(list(times), [list(p) for p in way], smooth=0.15, gaps=[(float(times[-1]), np.inf)])
    begin, end = float(times[2]) + 0.3, float(times[2]) + 1.3  # the box is moved between hands and floor
    yaw = float(np.degrees(np.arctan2(towards[1], towards[0])))

    def share(t: float) -> float:  # 0 in the hands, 1 on the floor
        done = smooth_step((t - begin) / (end - begin))
        return done if put_down else 1.0 - done

    person = person_on(path, _figure(staging, 4, speed), scene.ground, carrying=lambda t: 1.0 - share(t))

    def reference(t: float) -> Matrix:
        if share(t) >= 1.0:
            return scene.rest
        held = person.reference(t) @ pose((0.40 * size, 0, 0.92 * size))
        if share(t) <= 0.0:
            return held
        start = pose((*stand, scene.ground), yaw) @ pose((0.40 * size, 0, 0.92 * size))
        return se3.interpolate(start, scene.rest, share(t))

    name = "carried_box" if put_down else "removed_box"
    return [person, rigid(name, _solids("carton", size), reference, lambda t: put_down or t < times[-1])]


def _ball(staging: Staging) -> list[SyntheticMover]:
    scene, size = staging.scene, staging.scene.mover_scale
    radius, speed = 0.2 * size, staging.pace(0.8)
    path = staging.crossing(speed, speed)

    def reference(t: float) -> Matrix:
        return path.pose(t, scene.ground + radius) @ pose(pitch=float(np.degrees(path.at(t)[2] / radius)))

    return [rigid("ball", _solids("ball", size), reference, path.present)]


def _balloon(staging: Staging) -> list[SyntheticMover]:
    scene, size = staging.scene, staging.scene.mover_scale
    speed = staging.pace(0.4)
    path = staging.crossing(speed, 1.0)

    def reference(t: float) -> Matrix:
        position, _, _ = path.at(t)
        height = scene.ground + size * (1.35 + 0.15 * np.sin(1.7 * t))
        return pose((*position, height), 25 * np.sin(0.9 * t), 6 * np.sin(2.3 * t))

    return [rigid("balloon", _solids("balloon", size), reference, path.present)]


def _cart(path: FloorPath, scene: Scene, name: str) -> list[SyntheticMover]:
    solids = _solids("cart", scene.mover_scale)
    return [rigid(name, solids, lambda t: path.pose(t, scene.ground), path.present)]


def _creeper(staging: Staging) -> list[SyntheticMover]:
    speed = staging.pace(0.05)
    path = staging.crossing(speed, max(speed, staging.scene.mover_scale))
    return _cart(path, staging.scene, "creeper")


def _stopping(staging: Staging) -> list[SyntheticMover]:
    scene, speed = staging.scene, staging.pace(0.8)
    a, spot = np.asarray(scene.walk_line[0]), scene.rest[:2, 3]
    if staging.start_dynamic:
        a = spot + 0.5 * (a - spot)
    begin = 0.0 if staging.start_dynamic else 0.5
    end = begin + float(np.linalg.norm(spot - a)) / speed
    return _cart(FloorPath([begin, end], [list(a), list(spot)], smooth=0.2), scene, "stopping_cart")


def _starting(staging: Staging) -> list[SyntheticMover]:
    scene, speed = staging.scene, staging.pace(0.8)
    b, spot = np.asarray(scene.walk_line[1]), scene.rest[:2, 3]
    begin = 0.4 if staging.start_dynamic else 0.5 * staging.duration
    end = begin + float(np.linalg.norm(b - spot)) / speed
    path = FloorPath([begin, end], [list(spot), list(b)], smooth=0.2, gaps=[(end, np.inf)])
    return _cart(path, scene, "starting_cart")


def _door(staging: Staging) -> list[SyntheticMover]:
    scene, size = staging.scene, staging.scene.mover_scale
    angle = np.radians(95.0)
    swing = angle * 0.8 * size / staging.pace(0.5)
    begin = -0.3 * swing if staging.start_dynamic else 1.0

    def reference(t: float) -> Matrix:
        phase = (t - begin) % (2 * swing + 2.0) if t > begin else 0.0
        opened = smooth_step(phase / swing) - smooth_step((phase - swing - 1.0) / swing)
        return scene.hinge @ pose(yaw=-float(np.degrees(angle)) * opened)

    return [rigid("door", _solids("door", size), reference)]


MOVERS: dict[str, Callable[[Staging], list[SyntheticMover]]] = {
    "person": lambda staging: [_walker(staging, 0, 0.0, False, 0.0)],
    "people": _people,
    "wanderer": _wanderer,
    "carried_box": lambda staging: _carrier(staging, put_down=True),
    "removed_box": lambda staging: _carrier(staging, put_down=False),
    "ball": _ball,
    "balloon": _balloon,
    "creeper": _creeper,
    "stopping_cart": _stopping,
    "starting_cart": _starting,
    "door": _door,
}


def build_movers(names: tuple[str, ...], staging: Staging) -> list[SyntheticMover]:
    """Movers by name."""
    makers = [find(name, MOVERS, "mover") for name in names]
    return [mover for make in makers for mover in make(staging)]
