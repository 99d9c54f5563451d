"""The built-in static worlds; z is up, the floor is z = 0, metres."""

from collections.abc import Callable

import numpy as np

from dudmap.errors import ConfigError
from dudmap.synthetic.scene import (
    Light,
    Material,
    Primitive,
    Scene,
    box,
    capsule,
    cylinder,
    ellipsoid,
    look_at,
    pose,
    torus,
)

WOOD = Material("wood", (0.9, 0.9))
DARK_WOOD = Material("wood", (0.7, 0.7), tint=(0.6, 0.55, 0.5))
METAL = Material("plain", tint=(0.55, 0.57, 0.6), variation=0.3)
BLACK = Material("denim", (1.0, 1.0), tint=(0.2, 0.2, 0.22))
CARDBOARD = Material("cardboard", (1.6, 1.6))


def _shell(
    x: tuple[float, float], y: tuple[float, float], top: float, walls: Material, floor: Material
) -> list[Primitive]:
    """Floor, ceiling and four walls, 0.2 m thick, around the free box."""
    (x0, x1), (y0, y1), d = x, y, 0.2
    cx, cy, w, h = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0 + 2 * d, y1 - y0 + 2 * d
    ceiling = Material("plaster", (0.4, 0.4), tint=(1.05, 1.05, 1.05))
    return [
        box((cx, cy, -d / 2), (w, h, d), floor),
        box((cx, cy, top + d / 2), (w, h, d), ceiling),
        box((x0 - d / 2, cy, top / 2), (d, h, top), walls),
        box((x1 + d / 2, cy, top / 2), (d, h, top), walls),
        box((cx, y0 - d / 2, top / 2), (w, d, top), walls),
        box((cx, y1 + d / 2, top / 2), (w, d, top), walls),
    ]


def _table(center: tuple[float, float], size: tuple[float, float, float], material: Material) -> list[Primitive]:
    (x, y), (w, d, h) = center, size
    legs = [
        box((x + sx * (w / 2 - 0.05), y + sy * (d / 2 - 0.05), (h - 0.04) / 2), (0.06, 0.06, h - 0.04), material)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return [box((x, y, h - 0.02), (w, d, 0.04), material), *legs]


def _chair(center: tuple[float, float], yaw: float, material: Material) -> list[Primitive]:
    parts = [
        box((0, 0, 0.45), (0.44, 0.44, 0.05), Material("plaid", (2.3, 2.3))),
        box((0, 0.2, 0.75), (0.42, 0.04, 0.3), material),
    ]
    parts += [
        cylinder((sx * 0.19, sy * 0.19, 0), (sx * 0.19, sy * 0.19, 0.43), 0.02, METAL)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    parts += [cylinder((sx * 0.17, 0.2, 0.45), (sx * 0.17, 0.2, 0.75), 0.015, METAL) for sx in (-1, 1)]
    return [p.moved(pose((*center, 0), yaw)) for p in parts]


def _poster(
    x: float, y: float, z: float, size: tuple[float, float], quarter: int, depth: float = 0.03, side: bool = False
) -> Primitive:
    """Picture on a wall (facing -y, or along x with ``side``), showing one quarter of the poster texture."""
    w, h = size
    material = Material(
        "poster",
        (0.5 / w, 0.5 / h),
        ((quarter % 2) * 0.5 + 0.25, (quarter // 2) * 0.5 + 0.25),
        variation=0.05,
        faces=False,
    )
    extent = (depth, w, h) if side else (w, depth, h)
    return box((x, y, z), extent, material)


def _shelf(x: float, y: float, width: float, rows: int, yaw: float = 0.0) -> list[Primitive]:
    """Bookshelf standing at (x, y), open towards -y before it is turned by ``yaw``."""
    height, depth = 0.42 * rows, 0.3
    parts = [
        box((-width / 2 + 0.01, 0, height / 2), (0.02, depth, height), WOOD),
        box((width / 2 - 0.01, 0, height / 2), (0.02, depth, height), WOOD),
        box((0, depth / 2 - 0.005, height / 2), (width, 0.01, height), DARK_WOOD),
    ]
    for row in range(rows + 1):
        parts.append(box((0, 0, min(0.01 + 0.42 * row, height - 0.01)), (width, depth, 0.02), WOOD))
    for row in range(rows):
        books = Material("books", (1.0, 0.25 / 0.36), (0.13 * row, 0.25 * row), variation=0.05)
        length = width * (0.62 if row % 2 else 0.86)
        parts.append(box((-width / 2 + 0.03 + length / 2, 0.02, 0.02 + 0.42 * row + 0.16), (length, 0.2, 0.32), books))
    return [p.moved(pose((x, y, 0), yaw)) for p in parts]


def furnished_room(_: np.random.Generator) -> Scene:
    """Living room of 6 x 5 m: table, chairs, sofa, shelves, pictures, lamp, plant, boxes; openings in both side walls."""
    wall = Material("wallpaper", (0.5, 0.5))
    solids = [
        box((0, 0, -0.1), (9, 5.4, 0.2), Material("parquet", (0.55, 0.55))),
        box((0, 0, 2.7), (9, 5.4, 0.2), Material("plaster", (0.4, 0.4), tint=(1.05, 1.05, 1.05))),
        box((0, 2.6, 1.3), (9, 0.2, 2.6), wall),
        box((0, -2.6, 1.3), (9, 0.2, 2.6), Material("brick", (0.6, 0.6))),
    ]
    for side in (-1, 1):  # side walls with a doorway at y in [-0.35, 0.65], a corridor behind it
        solids += [
            box((side * 3.1, -1.425, 1.3), (0.2, 2.15, 2.6), wall),
            box((side * 3.1, 1.575, 1.3), (0.2, 1.85, 2.6), wall),
            box((side * 3.1, 0.15, 2.35), (0.2, 1.0, 0.5), wall),
            box((side * 4.4, 0, 1.3), (0.2, 5.4, 2.6), Material("checks", (0.5, 0.5))),
        ]
    solids += [
        box((0.1, 1.1, 0.006), (2.6, 1.9, 0.012), Material("rug", (1 / 2.6, 1 / 1.9), (0.5, 0.5), variation=0.05)),
        *_table((0.3, 1.25), (1.4, 0.8, 0.74), WOOD),
        *_chair((-0.2, 0.72), 190, DARK_WOOD),
        *_chair((1.35, 1.3), -80, DARK_WOOD),
        *_shelf(-2.2, 2.33, 1.2, 5),
        *_shelf(2.83, 1.7, 1.1, 4, -90),
        box((1.6, 2.35, 0.25), (1.5, 0.28, 0.5), Material("plaid", (1.3, 1.3), tint=(0.9, 0.8, 0.8))),
        box((1.6, 2.44, 0.6), (1.5, 0.12, 0.3), Material("plaid", (1.3, 1.3), tint=(0.9, 0.8, 0.8))),
        _poster(-0.55, 2.49, 1.6, (0.9, 0.65), 0),
        _poster(0.75, 2.49, 1.75, (0.6, 0.85), 1),
        _poster(1.9, 2.49, 1.55, (0.8, 0.6), 2),
        _poster(-2.99, 1.5, 1.5, (0.9, 0.7), 3, side=True),
        _poster(2.99, -1.4, 1.5, (1.0, 0.7), 0, side=True),
        box((-0.55, 2.3, 0.4), (1.1, 0.38, 0.8), DARK_WOOD),
        box((-0.75, 2.3, 1.0), (0.36, 0.06, 0.3), Material("poster", (1.4, 1.6), (0.2, 0.7), glow=0.3)),
        ellipsoid((-0.2, 2.28, 0.93), (0.13, 0.13, 0.13), Material("stripes", (2.5, 2.5))),
        # on the table
        box((0.62, 1.35, 0.83), (0.3, 0.22, 0.18), CARDBOARD, 25),
        box((0.1, 1.12, 0.755), (0.3, 0.21, 0.03), Material("paper", (3.3, 4.7)), 15),
        cylinder((-0.15, 1.4, 0.74), (-0.15, 1.4, 0.99), 0.045, Material("stripes", (4, 4))),
        torus((0.33, 1.02, 0.79), (0.3, 0, 1), 0.09, 0.025, Material("checks", (5, 5))),
        # plant, lamp, basket, boxes on the floor
        cylinder((-1.35, 2.1, 0), (-1.35, 2.1, 0.35), 0.17, Material("brick", (1.5, 1.5))),
        *[
            capsule((-1.35, 2.1, 0.35), (-1.35 + 0.35 * np.cos(a), 2.1 + 0.25 * np.sin(a), 0.75 + 0.25 * np.sin(2.3 * a)),
                    0.018, Material("grass", (2, 2)))
            for a in np.arange(7) * 0.9
        ],
        *[
            ellipsoid((-1.35 + 0.35 * np.cos(a), 2.1 + 0.25 * np.sin(a), 0.75 + 0.25 * np.sin(2.3 * a)), (0.13, 0.09, 0.06),
                      Material("grass", (2, 2)), 57.3 * a)
            for a in np.arange(7) * 0.9
        ],
        cylinder((2.55, 2.2, 0), (2.55, 2.2, 1.5), 0.02, METAL),
        cylinder((2.55, 2.2, 0), (2.55, 2.2, 0.03), 0.16, METAL),
        cylinder((2.55, 2.2, 1.45), (2.55, 2.2, 1.75), 0.18, Material("plaid", (2, 2), glow=0.4)),
        box((-2.6, -1.7, 0.3), (0.6, 0.5, 0.6), CARDBOARD, 10),
        box((-2.55, -1.75, 0.75), (0.4, 0.4, 0.3), CARDBOARD, 35),
        *_table((2.3, -1.9), (1.0, 0.6, 0.74), DARK_WOOD),
        box((2.3, -2.0, 0.99), (0.5, 0.06, 0.35), Material("paper", (2, 2.8), glow=0.3)),
    ]  # fmt: skip
    return Scene(
        name="room",
        primitives=solids,
        home=look_at((0.0, -1.55, 1.4), (0.1, 1.3, 0.95)),
        target=(0.1, 1.4, 0.95),
        space=((-2.3, -2.2, 0.8), (2.3, -0.7, 2.1)),
        walk_line=((-2.75, 0.2), (2.75, 0.2)),
        rest=pose((-0.85, 0.95, 0.012), 20),
        hinge=None,
        lights=(Light((-1.4, -0.8, 2.4), 0.5), Light((1.5, 0.8, 2.4), 0.5)),
    )


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "room": furnished_room,
}


def build_scene(name: str, seed: int = 0) -> Scene:
    """Build a scene by name.

    Raises:
        ConfigError: There is no scene of this name.
    """
    if name not in SCENES:
        raise ConfigError(f"unknown scene {name!r}; known scenes: {', '.join(SCENES)}")
    return SCENES[name](np.random.default_rng([seed, 1]))
