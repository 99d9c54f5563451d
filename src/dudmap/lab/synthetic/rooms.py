"""Built-in static scenes, which ``scenes.toml`` describes; z is up, lengths in metres.

A row of ``solids`` names a kind of solid or of furniture with its position (the start of a capsule or cylinder), its
other measures, and a material of the scene or of the furniture. A row with ``repeat`` (first, end, step) stands for
several, each with one of these numbers in place of every "*".
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from dudmap.errors import ConfigError
from dudmap.lab.data import tables
from dudmap.lab.synthetic import furniture
from dudmap.lab.synthetic.scene import (
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
)  # fmt: skip

MAKERS: dict[str, Any] = {
    "box": box, "ellipsoid": ellipsoid, "capsule": capsule, "cylinder": cylinder, "torus": torus,
    "table": furniture.table, "chair": furniture.chair, "poster": furniture.poster, "shelf": furniture.shelf,
    "plant": furniture.plant,
}  # fmt: skip
"""Functions that make a solid, or a list of them, from the values of a row."""


SCENES = tuple(tables("synthetic/scenes.toml"))
"""Names of the scenes."""


def build_scene(name: str) -> Scene:
    """Build a scene by name.

    Raises:
        ConfigError: There is no scene of this name.
    """
    if name not in SCENES:
        raise ConfigError(f"unknown scene {name!r}; known scenes: {', '.join(SCENES)}")
    table = dict(tables("synthetic/scenes.toml")[name])
    if "painted" in table:
        scene = build_scene(table["painted"])
        plain = [replace(p.material, texture="plain", variation=0.0, glow=0.0) for p in scene.primitives]
        solids = [replace(p, material=paint) for p, paint in zip(scene.primitives, plain, strict=True)]
        return replace(scene, name=name, primitives=solids)
    materials = furniture.MATERIALS | {key: Material(**row) for key, row in table.pop("materials").items()}
    return Scene(
        name=name,
        primitives=[solid for row in table.pop("solids") for solid in _solids(row, materials)],
        home=look_at(**table.pop("home")),
        rest=pose(**table.pop("rest")),
        hinge=pose(**table.pop("hinge")),
        lights=tuple(Light(**light) for light in table.pop("lights")),
        **table,
    )


def _solids(row: dict[str, Any], materials: dict[str, Material]) -> Iterator[Primitive]:
    """Solids of a row."""
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
