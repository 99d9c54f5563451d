"""Built-in static scenes; z is up, lengths in metres."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dudmap.errors import ConfigError
from dudmap.lab.synthetic.furniture import CARDBOARD, DARK_WOOD, METAL, WOOD, chair, plant, poster, shelf, shell, table
from dudmap.lab.synthetic.scene import Light, Material, Scene, box, capsule, cylinder, ellipsoid, look_at, pose, torus


def furnished_room() -> Scene:
    """Living room, 6 x 5 m: table, chairs, sofa, shelves, pictures, lamp, plant; a doorway in either side wall."""
    wall = Material("wallpaper", (0.5, 0.5))
    solids = [
        box((0, 0, -0.1), (9, 5.4, 0.2), Material("parquet", (0.55, 0.55))),
        box((0, 0, 2.7), (9, 5.4, 0.2), Material("plaster", (0.4, 0.4), tint=(1.05, 1.05, 1.05))),
        box((0, 2.6, 1.3), (9, 0.2, 2.6), wall),
        box((0, -2.6, 1.3), (9, 0.2, 2.6), Material("brick", (0.6, 0.6))),
    ]
    for side in (-1, 1):  # doorways at y in [-0.35, 0.65], a corridor behind each
        solids += [
            box((side * 3.1, -1.425, 1.3), (0.2, 2.15, 2.6), wall),
            box((side * 3.1, 1.575, 1.3), (0.2, 1.85, 2.6), wall),
            box((side * 3.1, 0.15, 2.35), (0.2, 1.0, 0.5), wall),
            box((side * 4.4, 0, 1.3), (0.2, 5.4, 2.6), Material("checks", (0.5, 0.5))),
        ]
    fabric = Material("plaid", (1.3, 1.3), tint=(0.75, 0.65, 0.62))
    solids += [
        box((0.1, 1.1, 0.006), (2.6, 1.9, 0.012), Material("rug", (1 / 2.6, 1 / 1.9), (0.5, 0.5), variation=0.05)),
        *table((0.3, 1.25), (1.4, 0.8, 0.74), WOOD),
        *chair((-0.2, 0.72), 190, DARK_WOOD),
        *chair((1.35, 1.3), -80, DARK_WOOD),
        *shelf(-2.2, 2.33, 1.2, 5),
        *shelf(2.83, 1.7, 1.1, 4, -90),
        box((1.6, 2.35, 0.25), (1.5, 0.28, 0.5), fabric),
        box((1.6, 2.44, 0.6), (1.5, 0.12, 0.3), fabric),
        poster(-0.55, 2.49, 1.6, (0.9, 0.65), 0),
        poster(0.75, 2.49, 1.75, (0.6, 0.85), 1),
        poster(1.9, 2.49, 1.55, (0.8, 0.6), 2),
        poster(-2.99, 1.5, 1.5, (0.9, 0.7), 3, side=True),
        poster(2.99, -1.4, 1.5, (1.0, 0.7), 0, side=True),
        poster(-1.2, -2.49, 1.5, (1.1, 0.8), 2),
        poster(1.0, -2.49, 1.6, (0.7, 0.9), 3),
        box((-0.55, 2.3, 0.4), (1.1, 0.38, 0.8), DARK_WOOD),
        box((-0.75, 2.3, 1.0), (0.36, 0.06, 0.3), Material("poster", (1.4, 1.6), (0.2, 0.7), glow=0.3)),
        ellipsoid((-0.2, 2.28, 0.93), (0.13, 0.13, 0.13), Material("stripes", (2.5, 2.5))),
        # on the table
        box((0.62, 1.35, 0.83), (0.3, 0.22, 0.18), CARDBOARD, 25),
        box((0.1, 1.12, 0.755), (0.3, 0.21, 0.03), Material("paper", (3.3, 4.7)), 15),
        cylinder((-0.15, 1.4, 0.74), (-0.15, 1.4, 0.99), 0.045, Material("stripes", (4, 4))),
        torus((0.33, 1.02, 0.775), (0, 0, 1), 0.09, 0.035, Material("checks", (5, 5))),
        # plant, lamp, boxes on the floor, a desk behind the camera
        *plant(-1.35, 2.1),
        cylinder((2.55, 2.2, 0), (2.55, 2.2, 1.5), 0.02, METAL),
        cylinder((2.55, 2.2, 0), (2.55, 2.2, 0.03), 0.16, METAL),
        cylinder((2.55, 2.2, 1.45), (2.55, 2.2, 1.75), 0.18, Material("plaid", (2, 2), glow=0.4)),
        box((-2.6, -1.7, 0.3), (0.6, 0.5, 0.6), CARDBOARD, 10),
        box((-2.55, -1.75, 0.75), (0.4, 0.4, 0.3), CARDBOARD, 35),
        *table((2.3, -1.9), (1.0, 0.6, 0.74), DARK_WOOD),
        box((2.3, -2.0, 0.99), (0.5, 0.06, 0.35), Material("paper", (2, 2.8), glow=0.3)),
    ]
    return Scene(
        name="room",
        primitives=solids,
        home=look_at((0.0, -1.55, 1.4), (0.1, 1.3, 0.95)),
        target=(0.1, 1.4, 0.95),
        space=((-2.3, -2.25, 0.6), (2.3, -0.5, 2.3)),
        extent=((-4.3, -2.5, 0.0), (4.3, 2.5, 2.6)),
        walk_line=((-2.75, 0.2), (2.75, 0.2)),
        rest=pose((-0.85, 0.95, 0.012), 20),
        hinge=pose((-1.75, 1.3, 0.0)),
        lights=(Light((-1.4, -0.8, 2.4), 0.5), Light((1.5, 0.8, 2.4), 0.5)),
    )


def corridor() -> Scene:
    """Corridor 2 m wide and 9 m long with pictures, pipes, a bench and side rooms; far ends are out of range."""
    wall = Material("plaster", (0.5, 0.5), tint=(0.95, 0.92, 0.8))
    solids = [
        box((0, 4.0, -0.1), (6.4, 10.4, 0.2), Material("checks", (0.4, 0.4))),
        box((0, 4.0, 2.6), (6.4, 10.4, 0.2), Material("plaster", (0.5, 0.5))),
        box((0, 9.1, 1.25), (6.4, 0.2, 2.5), Material("brick", (0.6, 0.6))),
        box((0, -1.1, 1.25), (6.4, 0.2, 2.5), wall),
    ]
    for side in (-1, 1):  # a side room opens at y in [2.6, 3.6]
        solids += [
            box((side * 1.1, 0.8, 1.25), (0.2, 3.6, 2.5), wall),
            box((side * 1.1, 6.3, 1.25), (0.2, 5.4, 2.5), wall),
            box((side * 1.1, 3.1, 2.3), (0.2, 1.0, 0.4), wall),
            box((side * 3.1, 4.0, 1.25), (0.2, 10.0, 2.5), Material("wallpaper", (0.5, 0.5))),
            box((side * 0.99, 1.5, 0.45), (0.02, 2.2, 0.9), Material("wood", (0.6, 0.6))),
            box((side * 0.99, 5.4, 0.45), (0.02, 3.6, 0.9), Material("wood", (0.6, 0.6))),
        ]
        solids += [
            poster(side * 0.99, y, 1.55, (0.7, 0.6), k, side=True) for k, y in enumerate((1.6, 4.2, 5.3, 6.6)[::side])
        ]
    solids += [
        box((-0.8, 4.6, 0.42), (0.36, 1.3, 0.06), WOOD),
        box((-0.8, 4.1, 0.2), (0.3, 0.06, 0.4), METAL),
        box((-0.8, 5.1, 0.2), (0.3, 0.06, 0.4), METAL),
        cylinder((0.93, 1.9, 0.5), (0.93, 1.9, 1.0), 0.065, Material("stripes", (3, 3), tint=(1.3, 0.4, 0.35))),
        capsule((-0.9, -0.9, 2.35), (-0.9, 8.9, 2.35), 0.05, METAL),
        capsule((0.9, -0.9, 2.3), (0.9, 8.9, 2.3), 0.03, Material("stripes", (1, 1), tint=(0.9, 0.7, 0.4))),
        *plant(0.65, 4.7, 0.25),
        box((0.75, 6.2, 0.3), (0.4, 0.5, 0.6), CARDBOARD, 12),
        box((-0.3, 2.2, 0.004), (0.7, 1.3, 0.008), Material("rug", (1.43, 0.77), (0.5, 0.5))),
    ]
    return Scene(
        name="corridor",
        primitives=solids,
        home=look_at((0.0, 0.1, 1.5), (0.0, 3.6, 1.0)),
        target=(0.0, 4.0, 1.0),
        space=((-0.7, -0.7, 0.8), (0.7, 1.6, 2.1)),
        extent=((-3.0, -1.0, 0.0), (3.0, 9.0, 2.5)),
        walk_line=((-2.2, 3.1), (2.2, 3.1)),
        rest=pose((0.45, 3.9, 0.0), 15),
        hinge=pose((-0.95, 2.55, 0.0), 0),
        lights=(Light((0.0, 1.0, 2.3), 0.4), Light((0.0, 4.5, 2.3), 0.5)),
    )


def desk() -> Scene:
    """Close-up of a desk: screen, keyboard, books, mug, paper, lamp; movers are the size of toys and walk on it."""
    top = 0.74
    spine = [Material("stripes", (4, 4), (0.13 * k, 0.29 * k)) for k in range(5)]
    solids = [
        box((0, 0.62, 1.2), (5, 0.04, 2.8), Material("wallpaper", (0.7, 0.7))),
        box((0, 0, -0.1), (5, 4, 0.2), Material("parquet", (0.6, 0.6))),
        box((0, 0.1, top - 0.02), (2.6, 1.0, 0.04), Material("wood", (0.9, 0.9))),
        *[box((x, y, 0.35), (0.06, 0.06, 0.7), METAL) for x in (-1.2, 1.2) for y in (-0.3, 0.5)],
        box((-0.1, 0.45, top + 0.32), (0.62, 0.04, 0.38), Material("paper", (1.6, 2.6), glow=0.45)),
        box((-0.1, 0.47, top + 0.32), (0.66, 0.03, 0.42), Material("denim", tint=(0.25, 0.25, 0.27))),
        cylinder((-0.1, 0.49, top), (-0.1, 0.49, top + 0.2), 0.03, METAL),
        cylinder((-0.1, 0.46, top), (-0.1, 0.46, top + 0.015), 0.12, METAL),
        box((-0.12, 0.14, top + 0.012), (0.44, 0.15, 0.024), Material("keyboard", (1 / 0.44, 1 / 0.15), (0.5, 0.5))),
        ellipsoid((0.2, 0.12, top + 0.01), (0.032, 0.055, 0.022), Material("denim", (3, 3), tint=(0.4, 0.4, 0.45))),
        cylinder((0.42, 0.12, top), (0.42, 0.12, top + 0.1), 0.04, Material("stripes", (5, 5))),
        torus((0.47, 0.12, top + 0.052), (0, 1, 0), 0.026, 0.007, Material("stripes", (5, 5))),
        box((0.4, -0.12, top + 0.004), (0.3, 0.21, 0.008), Material("paper", (3.3, 4.7)), 20),
        box((-0.52, -0.05, top + 0.006), (0.21, 0.3, 0.012), Material("paper", (4.7, 3.3), (0.4, 0.2)), -12),
        *[box((-0.68 + 0.012 * k, 0.3, top + 0.02 + 0.04 * k), (0.26, 0.19, 0.04), spine[k], 8 * k) for k in range(4)],
        *[box((0.45 + 0.045 * k, 0.42, top + 0.13), (0.04, 0.2, 0.26), spine[(k + 1) % 5]) for k in range(6)],
        cylinder((0.8, 0.3, top), (0.8, 0.3, top + 0.02), 0.08, METAL),
        capsule((0.8, 0.3, top), (0.86, 0.34, top + 0.4), 0.009, METAL),
        capsule((0.86, 0.34, top + 0.4), (0.66, 0.2, top + 0.55), 0.009, METAL),
        ellipsoid((0.64, 0.18, top + 0.54), (0.07, 0.07, 0.05), Material("plaid", (4, 4), glow=0.4)),
        *[
            capsule((-0.9 + 0.015 * k, 0.3, top + 0.05), (-0.9 + 0.03 * k, 0.31, top + 0.19), 0.004, spine[k])
            for k in range(5)
        ],
        cylinder((-0.87, 0.3, top), (-0.87, 0.3, top + 0.11), 0.042, Material("checks", (5, 5))),
        poster(-0.75, 0.595, 1.5, (0.4, 0.3), 1, 0.01),
        poster(0.6, 0.595, 1.45, (0.35, 0.45), 2, 0.01),
    ]  # fmt: skip
    return Scene(
        name="desk",
        primitives=solids,
        home=look_at((0.0, -0.75, 1.28), (0.0, 0.2, 0.85)),
        target=(0.0, 0.25, 0.85),
        space=((-0.5, -1.1, 1.05), (0.5, -0.5, 1.6)),
        extent=((-2.4, -1.9, 0.0), (2.4, 0.6, 2.6)),
        walk_line=((-1.25, -0.02), (1.25, -0.02)),
        rest=pose((0.2, -0.2, top), 25),
        hinge=pose((-0.35, 0.3, top)),
        lights=(Light((-0.7, -0.5, 2.2), 0.4, 0.02), Light((0.9, -0.2, 2.0), 0.35, 0.02)),
        detail=0.008,
        mover_scale=0.25,
        ground=top,
    )


def yard() -> Scene:
    """Yard under the sky: paving, house wall, fence of slats and thin wires, washing line, tree, bench, bin."""
    stone = Material("plaster", (1, 1), tint=(0.7, 0.68, 0.65), variation=0.5)
    slat, wire = Material("wood", (1, 1), tint=(0.9, 0.85, 0.8)), Material("plain", tint=(0.4, 0.4, 0.42))
    solids = [
        box((0, 2, -0.1), (16, 14, 0.2), Material("grass", (0.5, 0.5))),
        box((0.3, 0.8, 0.01), (4.2, 4.5, 0.02), Material("paving", (0.45, 0.45))),
        box((0.8, 4.1, 1.5), (7, 0.3, 3.0), Material("brick", (0.5, 0.5))),
        box((0.0, 3.93, 1.5), (1.0, 0.06, 1.1), Material("checks", (1, 1), tint=(0.5, 0.7, 0.9))),
        box((1.7, 3.93, 1.0), (0.9, 0.06, 2.0), Material("wood", (0.8, 0.5), tint=(0.5, 0.7, 0.55))),
        poster(-1.3, 3.93, 1.6, (0.7, 0.9), 3),
        *[box((-2.6, y, 0.7), (0.03, 0.09, 1.4), slat) for y in np.arange(-0.6, 3.9, 0.2)],
        box((-2.63, 1.6, 0.4), (0.03, 4.6, 0.07), slat),
        box((-2.63, 1.6, 1.1), (0.03, 4.6, 0.07), slat),
        *[cylinder((2.9, y, 0), (2.9, y, 1.5), 0.025, METAL) for y in np.arange(-0.8, 3.9, 1.15)],
        *[capsule((2.9, -0.8, z), (2.9, 3.8, z), 0.003, wire) for z in np.arange(0.15, 1.5, 0.15)],
        *[capsule((2.9, y, 0.0), (2.9, y, 1.45), 0.002, wire) for y in np.arange(-0.7, 3.8, 0.23)],
        *[capsule((-2.0, 2.6, z), (2.4, 2.9, z), 0.003, wire) for z in (1.85, 2.0)],
        box((-0.6, 2.69, 1.65), (0.5, 0.015, 0.4), Material("stripes", (1.8, 1.8))),
        box((0.5, 2.77, 1.6), (0.6, 0.015, 0.5), Material("plaid", (1.6, 1.6))),
        cylinder((-1.9, 2.6, 0), (-1.9, 2.6, 2.1), 0.04, METAL),
        cylinder((2.3, 2.9, 0), (2.3, 2.9, 2.1), 0.04, METAL),
        cylinder((-1.5, 3.2, 0), (-1.5, 3.2, 1.9), 0.13, Material("wood", (0.8, 0.3), tint=(0.6, 0.5, 0.4))),
        *[
            ellipsoid((-1.5 + 0.5 * np.cos(a), 3.1 + 0.35 * np.sin(a), 2.3 + 0.2 * np.sin(2 * a)), (0.5, 0.45, 0.4),
                      Material("grass", (1.2, 1.2), tint=(0.8, 0.9, 0.7)))
            for a in np.arange(5) * 1.26
        ],
        box((0.6, 2.3, 0.42), (1.3, 0.4, 0.05), slat),
        box((0.6, 2.5, 0.72), (1.3, 0.04, 0.25), slat),
        *[box((x, 2.3, 0.2), (0.07, 0.36, 0.4), METAL) for x in (0.1, 1.1)],
        cylinder((1.75, 2.0, 0), (1.75, 2.0, 0.75), 0.24, Material("stripes", (1.2, 1.2), tint=(0.6, 0.8, 0.6))),
        box((-1.3, 1.7, 0.22), (0.5, 0.4, 0.44), CARDBOARD, 25),
        ellipsoid((-0.6, 1.9, 0.16), (0.3, 0.22, 0.18), stone),
        *plant(-0.3, 3.3),
    ]  # fmt: skip
    return Scene(
        name="yard",
        primitives=solids,
        home=look_at((0.0, -1.5, 1.45), (0.1, 2.2, 0.95)),
        target=(0.1, 2.3, 0.95),
        space=((-2.0, -3.0, 0.7), (2.2, -0.4, 2.4)),
        extent=((-6.0, -4.0, 0.0), (6.0, 5.0, 4.0)),
        walk_line=((-2.45, 0.6), (2.75, 0.6)),
        rest=pose((-0.4, 1.15, 0.02), 20),
        hinge=pose((-2.0, 1.2, 0.02)),
        lights=(Light((25.0, -30.0, 40.0), 0.75, 0.0),),
        ambient=0.4,
        sky=(0.55, 0.72, 0.95),
    )


def textureless() -> Scene:
    """The furnished room painted in plain colours: only geometry and edges of shading are left."""
    room = furnished_room()
    plain = [
        replace(p, material=replace(p.material, texture="plain", variation=0.0, glow=0.0)) for p in room.primitives
    ]
    return replace(room, name="textureless", primitives=plain)


def plane() -> Scene:
    """One wall with a rich texture and nothing else: geometry fixes only three of six degrees of freedom."""
    wall = Material("poster", (0.35, 0.35), (0.25, 0.25), faces=False)
    return Scene(
        name="plane",
        primitives=[box((0, 1.1, 1.3), (9, 0.2, 6.0), wall)],
        home=look_at((0.0, -0.7, 1.3), (0.15, 1.0, 1.25)),
        target=(0.15, 1.0, 1.25),
        space=((-2.0, -1.2, 0.6), (2.0, 0.0, 2.0)),
        extent=((-4.0, -2.0, -1.6), (4.0, 1.0, 4.2)),
        walk_line=((-2.4, 0.5), (2.4, 0.5)),
        rest=pose((0.4, 0.75, 0.45), 20),
        hinge=pose((-0.8, 0.85, 0.45)),
        lights=(Light((-1.0, -1.5, 2.6), 0.5), Light((1.5, -1.0, 2.2), 0.4)),
        ground=0.45,
    )


def open_box() -> Scene:
    """Empty box-shaped room: the smallest world with all six degrees of freedom, for tests."""
    solids = [
        *shell((-1.5, 1.5), (-1.5, 1.5), 2.2, Material("wallpaper", (0.6, 0.6)), Material("parquet", (0.6, 0.6))),
        box((0.5, 0.8, 0.3), (0.5, 0.5, 0.6), CARDBOARD, 20),
        ellipsoid((-0.5, 0.9, 0.3), (0.3, 0.3, 0.3), Material("stripes", (1, 1))),
    ]
    return Scene(
        name="box",
        primitives=solids,
        home=look_at((0.0, -1.0, 1.3), (0.0, 1.0, 0.5)),
        target=(0.0, 1.0, 0.5),
        space=((-1.0, -1.2, 0.7), (1.0, -0.4, 1.9)),
        extent=((-1.5, -1.5, 0.0), (1.5, 1.5, 2.2)),
        walk_line=((-1.4, 0.3), (1.4, 0.3)),
        rest=pose((0.0, 0.5, 0.0), 20),
        hinge=pose((-0.9, 0.7, 0.0)),
        lights=(Light((0.0, -0.5, 2.0), 0.5),),
    )


SCENES: dict[str, Callable[[], Scene]] = {
    "room": furnished_room,
    "corridor": corridor,
    "desk": desk,
    "yard": yard,
    "textureless": textureless,
    "plane": plane,
    "box": open_box,
}


def build_scene(name: str) -> Scene:
    """Build a scene by name.

    Raises:
        ConfigError: There is no scene of this name.
    """
    if name not in SCENES:
        raise ConfigError(f"unknown scene {name!r}; known scenes: {', '.join(SCENES)}")
    return SCENES[name]()
