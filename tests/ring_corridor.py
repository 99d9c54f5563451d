"""A long corridor with rooms that leads round a block, and a walk through it that ends where it began."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence
from dudmap.lab.synthetic.rooms import CARDBOARD, WOOD, plant, poster, shelf, table
from dudmap.lab.synthetic.scene import Light, Material, Primitive, Scene, box, cylinder, look_at, pose

WIDTH, HEIGHT = 2.4, 2.5
"""Of the corridor, metres."""
ROOM_SPACING, ROOM_DEPTH, DOOR = 5.0, 3.0, 1.2
"""Distance between doors, depth of a room, and width of a door, metres."""
CORNER = 1.1
"""Radius of the walk at the corners, metres."""
EYES = 1.45
"""Height of the camera, metres."""
WALLS, FLOORS = ("wallpaper", "brick", "plaster", "wood"), ("checks", "parquet", "wood")
"""Textures. Each surface has its own part and scale of one. With equal scales the few pictures repeat exactly, and two
places look alike. Wear and stains darken and lighten each by up to a third."""


def ring_corridor(
    length: float, speed: float = 1.0, fps: float = 20.0, beyond: float = 12.0, camera: Camera = DEFAULT_CAMERA,
    seed: int = 0,
) -> SyntheticSequence:  # fmt: skip
    """Recording of a walk once round a corridor and on, so that the beginning is seen again.

    The walk is where it began after ``length`` (at least 40) metres and ends ``beyond`` metres later; the speed is in
    m/s. The seed is that of the furniture, the sway of the camera and the noise.
    """
    side = (length + (8 - 2 * np.pi) * CORNER) / 6  # the block is twice as long as wide
    corners = np.array([(0, 0), (2 * side, 0), (2 * side, side), (0, side)])
    frames = int((length + beyond) / speed * fps) + 1
    times = np.arange(frames) / fps
    poses = np.array([_pose(speed * t, corners, t) for t in times])
    return SyntheticSequence(
        _scene(corners, np.random.default_rng(seed)), [], Trajectory(times, poses), camera, noise="kinect", seed=seed,
        fps=fps,
    )  # fmt: skip


def _along(s: float, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Point (2,) of the walk at arc length ``s``, which begins in the middle of the first side."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    straight, arc = lengths - 2 * CORNER, np.pi / 2 * CORNER
    s = (s + straight[0] / 2) % (straight.sum() + 4 * arc)
    for corner, side, size, run in zip(corners, sides, lengths, straight, strict=True):
        along = side / size
        if s < run:
            return corner + along * (CORNER + s)
        s -= run
        if s < arc:
            inward = np.array([-along[1], along[0]])
            angle = s / CORNER
            return corner + along * (size - CORNER + CORNER * np.sin(angle)) + inward * CORNER * (1 - np.cos(angle))
        s -= arc
    raise AssertionError("the arc lengths add up to the whole walk")


def _pose(s: float, corners: NDArray[np.float64], t: float) -> NDArray[np.float64]:
    here, ahead = _along(s, corners), _along(s + 1.5, corners)
    forward = (ahead - here) / np.linalg.norm(ahead - here)
    aside = np.array([-forward[1], forward[0]])
    sway = np.sin(2 * np.pi * t / 7.3)
    eye = here + aside * 0.1 * np.sin(2 * np.pi * t / 3.1)
    target = here + 2.0 * forward + aside * 0.8 * sway
    return look_at((*eye, EYES + 0.03 * np.sin(2 * np.pi * t / 1.1)), (*target, 1.05))


def _scene(corners: NDArray[np.float64], rng: np.random.Generator) -> Scene:
    high = corners.max(axis=0)
    reach = WIDTH / 2 + ROOM_DEPTH + 0.5
    size = (*(high + 2 * reach), 0.2)
    solids = [
        box((*(high / 2), -0.11), size, Material("plaster", (0.4, 0.4))),
        box((*(high / 2), HEIGHT + 0.1), size, Material("plaster", (0.5, 0.5))),
        box((*(high / 2), HEIGHT / 2), (*(high - WIDTH), HEIGHT), Material("brick", (0.5, 0.5))),
    ]
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        solids += _rooms(corner, following, rng)
    return Scene(
        name="ring corridor",
        primitives=solids,
        home=look_at((*(_along(0, corners)), EYES), (*(_along(2, corners)), 1.0)),
        target=(float(_along(2, corners)[0]), 0.0, 1.0),
        space=((-reach, -reach, 0.8), (*(high + reach), 2.1)),
        extent=((-reach, -reach, 0.0), (*(high + reach), HEIGHT)),
        walk_line=((high[0] / 2 - 2, 0.0), (high[0] / 2 + 2, 0.0)),
        rest=pose((high[0] / 2, 0.4, 0.0)),
        hinge=pose(),
        lights=(Light((0.0, 0.0, HEIGHT), strength=0.0),),
        ambient=0.95,
    )


def _rooms(start: NDArray[np.float64], end: NDArray[np.float64], rng: np.random.Generator) -> list[Primitive]:
    """Outer wall of one side of the corridor with the rooms behind it, and what stands in corridor and rooms."""
    along = (end - start) / np.linalg.norm(end - start)
    yaw = float(np.degrees(np.arctan2(along[1], along[0])))
    T = pose((*start, 0.0), yaw)  # x along the corridor, y towards the inner wall
    length, wall, far = float(np.linalg.norm(end - start)), -WIDTH / 2, -WIDTH / 2 - ROOM_DEPTH
    solids = [box((length / 2, far - 0.1, HEIGHT / 2), (length + 2 * WIDTH, 0.2, HEIGHT), _material(rng, WALLS))]
    edges = np.arange(-WIDTH / 2, length + WIDTH / 2, ROOM_SPACING)
    for x in (*edges, length + WIDTH / 2):
        solids.append(box((x, (wall + far) / 2, HEIGHT / 2), (0.1, ROOM_DEPTH, HEIGHT), _material(rng, WALLS)))
    for first, last in zip(edges, np.append(edges[1:], length + WIDTH / 2), strict=True):
        door = (first + last) / 2 + rng.uniform(-0.5, 0.5)
        paint = _material(rng, WALLS)
        solids += _surfaces(max(first, WIDTH / 2), min(last, length - WIDTH / 2), far, rng)
        for low, high in ((first, door - DOOR / 2), (door + DOOR / 2, last)):
            if high > low:
                solids.append(box(((low + high) / 2, wall - 0.05, HEIGHT / 2), (high - low, 0.1, HEIGHT), paint))
        solids.append(box((door, wall - 0.05, HEIGHT - 0.2), (DOOR, 0.1, 0.4), paint))
        solids += _furniture(door, wall, far, rng)
        solids.append(_picture(first + 0.7, wall + 0.011, rng))
        if WIDTH < last - 1.0 < length - WIDTH:  # there is no inner wall at the corners
            solids.append(_picture(last - rng.uniform(0.7, 2.5), WIDTH / 2 - 0.011, rng))
    return [solid.moved(T) for solid in solids]


def _surfaces(first: float, last: float, far: float, rng: np.random.Generator) -> list[Primitive]:
    """Floor and inner wall between two places along the corridor; none at its corners."""
    middle, run = (first + last) / 2, last - first
    if run <= 0:
        return []
    return [
        box((middle, (WIDTH / 2 + far) / 2, -0.005), (run, WIDTH / 2 - far, 0.01), _material(rng, FLOORS)),
        box((middle, WIDTH / 2 - 0.005, HEIGHT / 2), (run, 0.01, HEIGHT), _material(rng, WALLS)),
    ]


def _picture(x: float, y: float, rng: np.random.Generator) -> Primitive:
    return poster((x, y, rng.uniform(1.3, 1.7)), (rng.uniform(0.5, 1.0), rng.uniform(0.4, 0.8)), int(rng.integers(4)))


def _furniture(door: float, wall: float, far: float, rng: np.random.Generator) -> list[Primitive]:
    """What is seen through a door, and beside it in the corridor."""
    x, y = door + rng.uniform(-0.6, 0.6), (wall + far) / 2
    inside: list[list[Primitive]] = [
        [*table((x, y), (1.2, 0.7, 0.74), WOOD), box((x, y, 0.85), (0.3, 0.25, 0.2), CARDBOARD, rng.uniform(0, 90))],
        shelf((x, far + 0.2), 1.2, 5, 180),
        [*plant((x, y)), box((x + 0.7, y, 0.4), (0.5, 0.5, 0.8), CARDBOARD, rng.uniform(0, 90))],
    ]
    beside = door + DOOR / 2 + rng.uniform(0.3, 0.8)
    outside: list[Primitive] = [
        box((beside, wall + 0.2, 0.3), (0.4, 0.35, rng.uniform(0.4, 0.7)), CARDBOARD, rng.uniform(-10, 10)),
        cylinder((beside, wall + 0.2, 0), (beside, wall + 0.2, rng.uniform(0.6, 1.2)), 0.12, _stripes(rng)),
    ]
    return [*inside[int(rng.integers(3))], outside[int(rng.integers(2))]]


def _material(rng: np.random.Generator, textures: tuple[str, ...]) -> Material:
    (red, green, blue), (u, v) = rng.uniform(0.75, 1.15, 3).tolist(), rng.uniform(0, 1, 2).tolist()
    scale = rng.uniform(0.3, 0.6, 2)
    scales = float(scale[0]), float(scale[1])
    return Material(str(rng.choice(textures)), scales, (u, v), (red, green, blue), variation=0.3)


def _stripes(rng: np.random.Generator) -> Material:
    return Material("stripes", (3, 3), (float(rng.uniform()), 0.0))
