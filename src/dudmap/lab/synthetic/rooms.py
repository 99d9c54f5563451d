"""Furniture and static scenes (``scenes.toml``); z up, metres.

A row of ``solids`` names solid or furniture, position (start of a capsule or cylinder), measures, material. ``repeat``
(first, end, step) puts each number in place of every "*".
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from dudmap.lab.data import find, tables
from dudmap.lab.synthetic.scene import (
    Light,
    Material,
    Primitive,
    Scene,
    Vector,
    box,
    capsule,
    cylinder,
    ellipsoid,
    look_at,
    pose,
    torus,
)  # fmt: skip

WOOD = Material("wood", (0.9, 0.9))
DARK_WOOD = Material("wood", (0.7, 0.7), tint=(0.6, 0.55, 0.5))
METAL = Material("plain", tint=(0.55, 0.57, 0.6), variation=0.3)
CARDBOARD = Material("cardboard", (1.6, 1.6))
MATERIALS = {"wood": WOOD, "dark wood": DARK_WOOD, "metal": METAL, "cardboard": CARDBOARD}


SOLIDS = tables("synthetic/solids.toml")


def table(center: tuple[float, float], size: tuple[float, float, float], material: Material) -> list[Primitive]:
    """Table of a width, depth and height on four legs."""
    (x, y), (w, d, h) = center, size
    legs = [
        box((x + sx * (w / 2 - 0.05), y + sy * (d / 2 - 0.05), (h - 0.04) / 2), (0.06, 0.06, h - 0.04), material)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return [box((x, y, h - 0.02), (w, d, 0.04), material), *legs]


def chair(center: tuple[float, float], yaw: float, material: Material) -> list[Primitive]:
    """Chair with its back towards +y, turned by ``yaw`` degrees."""
    materials = MATERIALS | {"back": material, "cushion": Material("plaid", (2.3, 2.3))}
    return [p.moved(pose((*center, 0), yaw)) for p in built(SOLIDS["furniture"]["chair"], materials)]


def poster(
    center: Vector, size: tuple[float, float], quarter: int, depth: float = 0.03, side: bool = False
) -> Primitive:
    """One quarter of the poster texture on a wall (facing -y, or along x with ``side``)."""
    (w, h), middle = size, ((quarter % 2) * 0.5 + 0.25, (quarter // 2) * 0.5 + 0.25)
    material = Material("poster", (0.5 / w, 0.5 / h), middle, variation=0.05, faces=False)
    return box(center, (depth, w, h) if side else (w, depth, h), material)


def shelf(center: tuple[float, float], width: float, rows: int, yaw: float = 0.0) -> list[Primitive]:
    """Bookshelf open towards -y, turned by ``yaw`` degrees."""
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
    return [p.moved(pose((*center, 0), yaw)) for p in parts]


def plant(center: tuple[float, float], spread: float = 0.35) -> list[Primitive]:
    """Pot with seven stalks and leaves."""
    x, y = center
    leaf = Material("grass", (2, 2))
    parts = [cylinder((x, y, 0), (x, y, 0.35), 0.17, Material("brick", (1.5, 1.5)))]
    for a in np.arange(7) * 0.9:
        tip = (x + spread * np.cos(a), y + 0.7 * spread * np.sin(a), 0.75 + 0.25 * np.sin(2.3 * a))
        parts.append(capsule((x, y, 0.35), tip, 0.018, leaf))
        parts.append(ellipsoid(tip, (0.13, 0.09, 0.06), leaf, 57.3 * a))
    return parts


MAKERS: dict[str, Any] = {
    "box": box, "ellipsoid": ellipsoid, "capsule": capsule, "cylinder": cylinder, "torus": torus,
    "table": table, "chair": chair, "poster": poster, "shelf": shelf, "plant": plant,
}  # fmt: skip


SCENES = tables("synthetic/scenes.toml")


def build_scene(name: str) -> Scene:
    """Scene of a name."""
    row = dict(find(name, SCENES, "scene"))
    if "painted" in row:
        scene = build_scene(row["painted"])
        plain = [replace(p.material, texture="plain", variation=0.0, glow=0.0) for p in scene.primitives]
        solids = [replace(p, material=paint) for p, paint in zip(scene.primitives, plain, strict=True)]
        return replace(scene, name=name, primitives=solids)
    materials = MATERIALS | {key: Material(**given) for key, given in row.pop("materials").items()}
    return Scene(
        name=name,
        primitives=built(row.pop("solids"), materials),
        home=look_at(**row.pop("home")),
        rest=pose(**row.pop("rest")),
        hinge=pose(**row.pop("hinge")),
        lights=tuple(Light(**light) for light in row.pop("lights")),
        **row,
    )


def built(rows: Iterable[dict[str, Any]], materials: dict[str, Material]) -> list[Primitive]:
    """Solids of rows, whose materials have these names."""
    return [solid for row in rows for solid in _solids(row, materials)]


def _solids(row: dict[str, Any], materials: dict[str, Material]) -> Iterator[Primitive]:
    row = dict(row)
    for number in np.arange(*row.pop("repeat")) if "repeat" in row else (None,):
        values: list[Any] = [
            [number if x == "*" else x for x in value] if isinstance(value, tuple) else value for value in row.values()
        ]
        kind, *keys = row
        named = dict(zip(keys, values[1:], strict=True))
        if "material" in named:
            named["material"] = materials[named["material"]]
        made = MAKERS[kind](values[0], **named)
        yield from made if isinstance(made, list) else [made]
