"""Things that move: walking people, boxes carried and put down, balls, balloons, creepers, doors."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.geometry import se3
from dudmap.synthetic.motion import Track, crossing, smooth_step
from dudmap.synthetic.person import Figure
from dudmap.synthetic.scene import Material, Primitive, Scene, box, capsule, cylinder, ellipsoid, pose

Matrix = NDArray[np.float64]
Line = tuple[tuple[float, float], tuple[float, float]]
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
        settles: Whether it counts as static while it rests; people never do.
    """

    name: str
    primitives: list[Primitive]
    parts: Callable[[float], Matrix]
    reference: Callable[[float], Matrix]
    present: Callable[[float], bool] = lambda _: True
    settles: bool = True

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
    """What a mover needs to know.

    Attributes:
        scene: Where it moves.
        rng: Chance.
        speed: Wished speed in m/s, None for the mover's own.
        duration: Seconds to fill.
        start_dynamic: Whether it is in view, moving, at the first frame.
    """

    scene: Scene
    rng: np.random.Generator
    speed: float | None
    duration: float
    start_dynamic: bool

    def pace(self, natural: float) -> float:
        """The wished speed, or ``natural`` (for people of life size) scaled to the scene."""
        return self.speed if self.speed is not None else natural * self.scene.mover_scale


def person_on(
    track: Track,
    figure: Figure,
    ground: float,
    name: str = "person",
    carrying: Callable[[float], float] = lambda _: 0.0,
) -> Mover:
    """A person who walks a track; ``carrying`` tells how far the arms are lifted at a time, 0 to 1."""

    def reference(t: float) -> Matrix:
        position, yaw, _ = track.at(t)
        return pose((*position, ground), float(np.degrees(yaw)))

    def parts(t: float) -> Matrix:
        return figure.poses(reference(t), track.at(t)[2], carrying(t))

    return Mover(name, figure.primitives, parts, reference, track.present, settles=False)


def rigid(
    name: str,
    primitives: list[Primitive],
    reference: Callable[[float], Matrix],
    present: Callable[[float], bool] = lambda _: True,
) -> Mover:
    """A mover in one piece."""
    return Mover(name, primitives, lambda t: np.tile(reference(t), (len(primitives), 1, 1)), reference, present)


def shifted(line: Line, shift: float, reverse: bool = False) -> Line:
    """The line moved by ``shift`` metres to its left, turned round with ``reverse``."""
    a, b = np.asarray(line[0]), np.asarray(line[1])
    normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    (ax, ay), (bx, by) = (end + shift * normal for end in (a, b))
    start, end = (float(ax), float(ay)), (float(bx), float(by))
    return (end, start) if reverse else (start, end)


def _figure(staging: Staging, outfit: int, speed: float) -> Figure:
    size = staging.scene.mover_scale
    return Figure(staging.rng, outfit, size, 1.35 * float(np.clip(np.sqrt(speed / size / 1.2), 0.35, 1.2)))


def _walker(staging: Staging, outfit: int, shift: float, reverse: bool, delay: float) -> Mover:
    scene, speed = staging.scene, staging.pace(1.2)
    track = crossing(
        shifted(scene.walk_line, shift * scene.mover_scale, reverse),
        speed,
        staging.duration,
        enter=1.0 + delay,
        start_inside=staging.start_dynamic,
        entry_speed=1.2 * scene.mover_scale,
    )
    return person_on(track, _figure(staging, outfit, speed), scene.ground)


def _people(staging: Staging) -> list[Mover]:
    return [_walker(staging, 1, 0.0, False, 0.0), _walker(staging, 2, 0.3, True, 0.6)]


def _wanderer(staging: Staging) -> list[Mover]:
    """A person who walks round and round in view and never leaves."""
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
    track = Track(list(times[keep] - 1.5), loop[keep].tolist(), smooth=0.1)
    return [person_on(track, _figure(staging, 3, speed), scene.ground)]


CARTON = (0.36, 0.30, 0.28)


def _carton(size: float) -> list[Primitive]:
    x, y, z = (extent * size for extent in CARTON)
    return [box((0, 0, z / 2), (x, y, z), Material("cardboard", (1.9 / size, 1.9 / size)))]


def _carrier(staging: Staging, put_down: bool) -> list[Mover]:
    """A person brings a box, puts it down and leaves; or comes, takes it and leaves with it."""
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
    track = Track(list(times), [list(p) for p in way], smooth=0.15, gaps=[(float(times[-1]), np.inf)])
    begin, end = float(times[2]) + 0.3, float(times[2]) + 1.3  # the box changes hands in between
    yaw = float(np.degrees(np.arctan2(towards[1], towards[0])))

    def share(t: float) -> float:  # 0 in the hands, 1 on the floor
        done = smooth_step((t - begin) / (end - begin))
        return done if put_down else 1.0 - done

    person = person_on(track, _figure(staging, 4, speed), scene.ground, carrying=lambda t: 1.0 - share(t))

    def reference(t: float) -> Matrix:
        if share(t) >= 1.0:
            return scene.rest
        held = person.reference(t) @ pose((0.40 * size, 0, 0.92 * size))
        if share(t) <= 0.0:
            return held
        start = pose((*stand, scene.ground), yaw) @ pose((0.40 * size, 0, 0.92 * size))
        return se3.interpolate(start, scene.rest, share(t))

    def present(t: float) -> bool:
        return put_down or t < times[-1]

    return [person, rigid("carried_box" if put_down else "removed_box", _carton(size), reference, present)]


def _ball(staging: Staging) -> list[Mover]:
    scene, size = staging.scene, staging.scene.mover_scale
    radius, speed = 0.2 * size, staging.pace(0.8)
    track = crossing(scene.walk_line, speed, staging.duration, start_inside=staging.start_dynamic, entry_speed=speed)

    def reference(t: float) -> Matrix:
        position, yaw, walked = track.at(t)
        rolled = pose((*position, scene.ground + radius), float(np.degrees(yaw)))
        return rolled @ pose(pitch=float(np.degrees(walked / radius)))

    skin = Material("checks", (1.5 / size, 1.5 / size), tint=(1.2, 0.7, 0.5))
    return [rigid("ball", [ellipsoid((0, 0, 0), (radius,) * 3, skin)], reference, track.present)]


def _balloon(staging: Staging) -> list[Mover]:
    scene, size = staging.scene, staging.scene.mover_scale
    speed = staging.pace(0.4)
    track = crossing(scene.walk_line, speed, staging.duration, start_inside=staging.start_dynamic, entry_speed=1.0)

    def reference(t: float) -> Matrix:
        position, _, _ = track.at(t)
        height = scene.ground + size * (1.35 + 0.15 * np.sin(1.7 * t))
        return pose((*position, height), 25 * np.sin(0.9 * t), 6 * np.sin(2.3 * t))

    skin = Material("stripes", (1.2 / size, 1.2 / size), tint=(1.2, 0.6, 0.7))
    solids = [
        ellipsoid((0, 0, 0), (0.2 * size, 0.2 * size, 0.25 * size), skin),
        capsule((0, 0, -0.25 * size), (0, 0, -0.7 * size), 0.004 * size, Material("plain")),
    ]
    return [rigid("balloon", solids, reference, track.present)]


def _cart_solids(size: float) -> list[Primitive]:
    rubber = Material("denim", (3, 3), tint=(0.25, 0.25, 0.25))
    body = box((0, 0, 0.38 * size), (0.5 * size, 0.4 * size, 0.6 * size), Material("books", (1.6 / size, 1.6 / size)))
    wheels = [
        cylinder((x * size, y * size - 0.02 * size, 0.06 * size), (x * size, y * size + 0.02 * size, 0.06 * size),
                 0.06 * size, rubber)
        for x in (-0.18, 0.18) for y in (-0.15, 0.15)
    ]  # fmt: skip
    return [body, *wheels]


def _cart(track: Track, scene: Scene, name: str) -> Mover:
    def reference(t: float) -> Matrix:
        position, yaw, _ = track.at(t)
        return pose((*position, scene.ground), float(np.degrees(yaw)))

    return rigid(name, _cart_solids(scene.mover_scale), reference, track.present)


def _creeper(staging: Staging) -> list[Mover]:
    """A cart that rolls in briskly and then creeps through the view at 5 cm/s."""
    speed = staging.pace(0.05)
    quick = max(speed, 1.0 * staging.scene.mover_scale)
    track = crossing(
        staging.scene.walk_line, speed, staging.duration, start_inside=staging.start_dynamic, entry_speed=quick
    )
    return [_cart(track, staging.scene, "creeper")]


def _stopping(staging: Staging) -> list[Mover]:
    """A cart that rolls in and stops in view for good."""
    scene, speed = staging.scene, staging.pace(0.8)
    a, spot = np.asarray(scene.walk_line[0]), scene.rest[:2, 3]
    if staging.start_dynamic:
        a = spot + 0.5 * (a - spot)
    begin = 0.0 if staging.start_dynamic else 0.5
    end = begin + float(np.linalg.norm(spot - a)) / speed
    return [_cart(Track([begin, end], [list(a), list(spot)], smooth=0.2), scene, "stopping_cart")]


def _starting(staging: Staging) -> list[Mover]:
    """A cart that stands in view like furniture and rolls away half-way through."""
    scene, speed = staging.scene, staging.pace(0.8)
    b, spot = np.asarray(scene.walk_line[1]), scene.rest[:2, 3]
    begin = 0.4 if staging.start_dynamic else 0.5 * staging.duration
    end = begin + float(np.linalg.norm(b - spot)) / speed
    track = Track([begin, end], [list(spot), list(b)], smooth=0.2, gaps=[(end, np.inf)])
    return [_cart(track, scene, "starting_cart")]


def _door(staging: Staging) -> list[Mover]:
    """A door leaf that opens, stays and closes again."""
    scene, size = staging.scene, staging.scene.mover_scale
    width, height, angle = 0.8 * size, 1.95 * size, np.radians(95.0)
    swing = angle * width / staging.pace(0.5)
    begin = -0.3 * swing if staging.start_dynamic else 1.0
    leaf = Material("wood", (0.9 / size, 0.7 / size), tint=(0.75, 0.85, 0.95))
    handle = Material("plain", tint=(0.9, 0.8, 0.4))
    solids = [
        box((width / 2, 0, height / 2), (width, 0.04 * size, height), leaf),
        cylinder((0, 0, 0), (0, 0, height), 0.035 * size, handle),
        capsule(
            (width * 0.9, -0.05 * size, 1.0 * size), (width * 0.75, -0.05 * size, 1.0 * size), 0.012 * size, handle
        ),
    ]

    def reference(t: float) -> Matrix:
        phase = (t - begin) % (2 * swing + 2.0) if t > begin else 0.0
        opened = smooth_step(phase / swing) - smooth_step((phase - swing - 1.0) / swing)
        return scene.hinge @ pose(yaw=-float(np.degrees(angle)) * opened)

    return [rigid("door", solids, reference)]


MOVERS: dict[str, Callable[[Staging], list[Mover]]] = {
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
