"""Two visits to one place with true changes."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.atomic_file import write_text
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError
from dudmap.lab.data import find
from dudmap.lab.synthetic.folder import write_folder
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.render import Renderer
from dudmap.lab.synthetic.rooms import chair, shelf
from dudmap.lab.synthetic.scene import Light, Material, Primitive, Scene, box, cylinder, ellipsoid, pose
from dudmap.lab.synthetic.setup import sequence
from dudmap.lab.synthetic.surface import count_views, tessellate

Array = NDArray[np.float64]
TRUTH = "changes.json"
SKINS = ("cardboard", "books", "plaid", "checks", "denim", "brick", "stripes", "paper")
KINDS = {"appeared", "disappeared", "moved", "opened", "recoloured"}
NEAREST, FARTHEST, GRAZING = 0.5, 4.5, 0.2
"""Distances (m) and smallest cosine of incidence of an observed surface."""
VIEWS = 5
"""Frames, of 30, that see a surface, or look through it."""
CLEAR = 0.03
"""Distance behind a point, metres, of a ray through it: twice a Kinect's noise at 2.5 m."""
LEAST_SEEN = 0.35
"""Smallest observed share of a changed thing's face."""
NORMAL_LENGTH = 0.05
"""Length of normals in the comparison of sides, metres: 3 cm are 35 degrees."""
GAP = 0.12
"""Distance between things and solids, metres."""
TRIES = 400


@dataclass(frozen=True, eq=False)
class TrueChange:
    """True change of a thing.

    Attributes:
        kind: Of ``KINDS`` without "opened", or "unknown" if a visit could not see it.
        size: Longest edge, metres.
        T_after_before: (4, 4), common frame; identity if not moved.
        before, after: (n, 3) surface that one visit saw and the other looked through, metres; of a recoloured thing, in
            both visits.
        symmetric: About its vertical axis.
        common: Whether both visits saw the same sides.
        at: (3,) centre before, else after.
    """

    thing: str
    kind: str
    size: float
    T_after_before: Array
    before: Array
    after: Array
    symmetric: bool
    at: Array
    common: bool = True

    def tree(self) -> dict[str, Any]:
        """Values for a JSON file."""
        return {
            "thing": self.thing, "kind": self.kind, "size": round(self.size, 3), "symmetric": self.symmetric,
            "common": self.common,
            "T_after_before": self.T_after_before.tolist(), "centre": self.at.round(4).tolist(),
            "before": self.before.round(4).tolist(), "after": self.after.round(4).tolist(),
        }  # fmt: skip


def _skin(rng: np.random.Generator, size: float) -> Material:
    scale = float(rng.uniform(0.5, 1.0)) / size
    tint = tuple(float(x) for x in rng.uniform(0.5, 1.15, 3))
    return Material(str(rng.choice(SKINS)), (scale, scale), tuple(rng.uniform(0, 1, 2)), tint)  # pyright: ignore


def _box(rng: np.random.Generator, size: float) -> list[Primitive]:
    w, d, h = size * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.7, 1.0)])[rng.permutation(3)]
    return [box((0, 0, h / 2), (w, d, h), _skin(rng, size))]


def _ball(rng: np.random.Generator, size: float) -> list[Primitive]:
    return [ellipsoid((0, 0, size / 2), (size / 2,) * 3, _skin(rng, size))]


def _bin(rng: np.random.Generator, size: float) -> list[Primitive]:
    return [cylinder((0, 0, 0), (0, 0, size), size * float(rng.uniform(0.3, 0.45)), _skin(rng, size))]


def _chair(rng: np.random.Generator, size: float) -> list[Primitive]:
    return chair((0, 0), 0.0, _skin(rng, 0.5))


def _shelf(rng: np.random.Generator, size: float) -> list[Primitive]:
    return shelf((0, 0), 0.8, int(rng.integers(3, 5)))


def _door(rng: np.random.Generator, size: float) -> list[Primitive]:
    return [box((0.4, 0, 0.975), (0.8, 0.04, 1.95), Material("wood", (0.9, 0.7), tint=(0.75, 0.85, 0.95)))]


THINGS: dict[str, tuple[Callable[[np.random.Generator, float], list[Primitive]], tuple[float, float], bool]] = {
    "box": (_box, (0.1, 0.8), False), "ball": (_ball, (0.15, 0.5), True), "bin": (_bin, (0.1, 0.6), True),
    "chair": (_chair, (0.9, 0.9), False), "shelf": (_shelf, (1.26, 1.68), False), "door": (_door, (1.95, 1.95), False),
    "poster": (_box, (0.3, 1.0), False),
}  # fmt: skip
"""Maker of the solids, range of the longest edge in metres, symmetry."""


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing in the frame of each visit; a poster's solids are on its wall."""

    name: str
    kind: str
    size: float
    before: list[Primitive]
    after: list[Primitive]
    T_after_before: Array


def parsed_changes(text: str) -> list[tuple[str, str]]:
    """Names and kinds of ``chair:moved,box:appeared``; "none" is empty.

    Raises:
        ConfigError: An unknown thing or kind, or an unsuitable kind.
    """
    out = []
    for part in (part.strip() for part in text.split(",") if part.strip() not in ("", "none")):
        name, _, kind = part.partition(":")
        find(name, THINGS, "thing")
        if kind not in KINDS or (kind == "recoloured") != (name == "poster") or (kind == "opened" and name != "door"):
            raise ConfigError(
                f"cannot understand the change {part!r}; expected THING:KIND with a thing of {', '.join(THINGS)}, "
                "moved, appeared or disappeared, door:opened, or poster:recoloured"
            )
        out.append((name, kind))
    return out


class _Stage:
    def __init__(self, scene: Scene, recording: SyntheticSequence, rng: np.random.Generator) -> None:
        self.scene, self.rng, self.taken = scene, rng, list[Array]()
        camera = recording.camera.resized(64, 48)
        empty = np.empty((0, 4, 4)), np.empty(0, bool)
        depth = Renderer(scene, scene.primitives).render(camera, scene.home, *empty, with_color=False).depth
        points = camera.backproject(depth).astype(float) @ scene.home[:3, :3].T + scene.home[:3, 3]
        flat = np.abs(points[1:, :, 2] - points[:-1, :, 2]) < 0.004
        near = (depth > NEAREST + 0.4) & (depth < FARTHEST - 0.5)
        near[:, :6] = near[:, -6:] = near[-4:] = False
        self.spots = points[:-1][flat & near[:-1]]

    def put(self, solids: list[Primitive], around: Array | None = None) -> Array | None:
        solid = _samples(solids)
        far = float(np.exp(self.rng.uniform(np.log(0.05), np.log(3.0))))
        for _ in range(TRIES):
            if around is None:
                T = pose(self.spots[self.rng.integers(len(self.spots))], float(self.rng.uniform(-180, 180)))
            else:
                angle, turn = self.rng.uniform(0, 2 * np.pi), float(self.rng.normal() * min(60 * far, 90))
                T = pose((*(far * np.array([np.cos(angle), np.sin(angle)])), 0)) @ around @ pose(yaw=turn)
            if self._is_free(solid @ T[:3, :3].T + T[:3, 3], around is not None and far < 0.5):
                return T
            far = far if around is None else max(0.05, far * 0.99)
        return None

    def _is_free(self, points: Array, overlapping: bool) -> bool:
        low = points[:, 2].min()
        above = points[points[:, 2] > low + 0.02]
        if not self._in_view(points.mean(axis=0)) or self.scene.clearance(above).min() < 0.02:
            return False
        feet = points[points[:, 2] < low + 0.005] - (0, 0, 0.015)
        if self.scene.clearance(feet).max() > 0.004:
            return False
        others = self.taken[:-1] if overlapping else self.taken
        return all(np.linalg.norm(points[:, None] - other[None], axis=2).min() > GAP for other in others)

    def _in_view(self, point: Array) -> bool:
        local = se3.inverse(self.scene.home) @ np.append(point, 1)
        return bool(
            local[2] > 0.8 * min(1.0, self.scene.mover_scale * 2) and np.all(np.abs(local[:2]) < 0.5 * local[2])
        )


def _samples(solids: list[Primitive]) -> Array:
    axis = np.linspace(-1, 1, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    grid = grid[np.abs(grid).max(axis=1) == 1]
    parts = [(grid * p.bounds()) @ p.T_body_primitive[:3, :3].T + p.T_body_primitive[:3, 3] for p in solids]
    return np.concatenate(parts)


def _placed(name: str, kind: str, stage: _Stage, size: float | None) -> Thing | None:
    rng, scene = stage.rng, stage.scene
    make, (low, high), _ = THINGS[name]
    if name == "poster":
        posters = (p for p in scene.primitives if p.material.texture == "poster")
        pictures = [p for p in posters if stage._in_view(p.T_body_primitive[:3, 3])]
        if not pictures:
            return None
        old = pictures[rng.integers(len(pictures))]
        other = (old.material.offset[0] + 0.5, old.material.offset[1] + float(rng.choice([0.0, 0.5])))
        new = replace(old, material=replace(old.material, offset=other))
        return Thing(name, kind, float(2 * max(old.half)), [old], [new], np.eye(4))
    scaled = low < high and name != "shelf"
    size = size or float(
        np.exp(rng.uniform(np.log(low), np.log(high * (min(1.0, 2 * scene.mover_scale) if scaled else 1))))
    )
    solids = make(rng, size)
    if name == "door":
        first, second = scene.hinge, scene.hinge @ pose(yaw=-float(rng.uniform(20, 95)))
        if kind != "opened":
            first, second = (None, first) if kind == "appeared" else (first, None)
    else:
        first = stage.put(solids)
        if first is None:
            return None
        stage.taken.append(_samples(solids) @ first[:3, :3].T + first[:3, 3])
        second = stage.put(solids, first) if kind == "moved" else None
        if kind == "moved" and second is None:
            return None
        if kind == "appeared":
            first, second = None, first
    for T in (first, second):
        if T is not None:
            stage.taken.append(_samples(solids) @ T[:3, :3].T + T[:3, 3])
    before, after = ([] if T is None else [p.moved(T) for p in solids] for T in (first, second))
    motion = np.eye(4) if first is None or second is None else second @ se3.inverse(first)
    return Thing(name, kind, size, before, after, motion)


def visits(
    changes: Sequence[tuple[str, str]],
    *,
    scene: str = "room",
    seed: int = 0,
    size: float | None = None,
    people: bool = False,
    other_light: bool = False,
    paths: tuple[str, str] = ("pan", "pan"),
    **options: Any,  # noqa: ANN401 - those of ``sequence``
) -> tuple[list[SyntheticSequence], list[TrueChange]]:
    """Recordings before and after changes, in one world frame, and the visible true changes.

    Args:
        changes: From ``parsed_changes``.
        size: Longest edge of boxes, balls and bins, metres; None draws it.
        people: Walk through the second visit.
        other_light: Lamps of the second visit are elsewhere.

    Raises:
        ConfigError: An unknown name, or no free place in view.
    """
    rng = np.random.default_rng([seed, 7])
    plain = sequence(scene, (), paths[0], seed=seed, **options)
    stage = _Stage(plain.scene, plain, rng)
    things: list[Thing] = []
    for name, kind in changes:
        made = next((t for _ in range(8) if (t := _placed(name, kind, stage, size)) is not None), None)
        if made is None:
            raise ConfigError(f"there is no free place for {name}:{kind} in the scene {scene}; take another --seed")
        things.append(made)
    recordings = []
    for visit in range(2):
        walkers = ("people",) if people and visit else ()
        like = sequence(scene, walkers, paths[visit], seed=seed + 1000 * visit, **options)
        solids = [p for p in like.scene.primitives if not any(_is_same(p, old) for t in things for old in t.before)]
        solids += [p for thing in things for p in (thing.after if visit else thing.before)]
        lights = like.scene.lights
        if other_light and visit:
            lights = tuple(Light((-x.position[1], x.position[0], x.position[2]), 0.8 * x.strength) for x in lights)
        recordings.append(like.in_scene(replace(like.scene, primitives=solids, lights=lights)))
    return recordings, [_truth(thing, recordings) for thing in things]


def _is_same(a: Primitive, b: Primitive) -> bool:
    return a.half == b.half and np.array_equal(a.T_body_primitive, b.T_body_primitive)


def _truth(thing: Thing, recordings: list[SyntheticSequence]) -> TrueChange:
    recoloured = thing.kind == "recoloured"
    changed, shown, areas = [], [], []
    for own, other, solids in zip(recordings, recordings[::-1], (thing.before, thing.after), strict=True):
        if not solids:
            changed.append(np.empty((0, 3)))
            areas.append(0.0)
            continue
        surface = tessellate(solids, min(0.02, thing.size / 12), own.scene.extent, own.renderer.atlas)
        vertices, seen = surface.vertices.astype(float), _views(surface, own) >= VIEWS
        through = (_views(surface, other) if recoloured else _looks_through(surface, other)) >= VIEWS
        changed.append(vertices[seen & through])
        oriented = np.hstack([vertices, NORMAL_LENGTH * surface.normals])
        shown.append((oriented[seen & through], oriented[seen]))
        areas.append(surface.area() / max(len(vertices), 1))
    edges = np.sort(np.ptp(_samples(thing.before or thing.after), axis=0))
    kind = "moved" if thing.kind == "opened" else thing.kind
    least = LEAST_SEEN * edges[1] * edges[2] * (0.3 if kind == "moved" else 1)
    enough, common = [area * len(points) > least for area, points in zip(areas, changed, strict=True)], True
    if kind == "moved" and not all(enough):
        kind = "disappeared" if enough[0] else "appeared" if enough[1] else "unknown"
    elif kind == "moved":
        common = any(
            area * (KDTree(others).query(_moved(T, own))[0] < CLEAR).sum() > least
            for area, (own, _), (_, others), T in zip(
                areas, shown, shown[::-1], (thing.T_after_before, se3.inverse(thing.T_after_before)), strict=True
            )
        )
    elif not any(enough):
        kind = "unknown"
    at = _samples(thing.before or thing.after).mean(axis=0)
    symmetric, (before, after) = THINGS[thing.name][2], changed
    return TrueChange(thing.name, kind, thing.size, thing.T_after_before, before, after, symmetric, at, bool(common))


def _moved(T: Array, oriented: Array) -> Array:
    return np.hstack([oriented[:, :3] @ T[:3, :3].T + T[:3, 3], oriented[:, 3:] @ T[:3, :3].T])


def _shots(recording: SyntheticSequence) -> list[tuple[Array, NDArray[np.float32]]]:
    still = recording.static_twin()
    frames = np.unique(np.linspace(0, len(still) - 1, min(len(still), 30)).astype(int))
    return [(still.ground_truth.Ts_world_camera[n], still.exact_depth(int(n))) for n in frames]


def _views(surface: Mesh, recording: SyntheticSequence) -> NDArray[np.int32]:
    return count_views(surface, recording.camera, _shots(recording), (NEAREST, FARTHEST), GRAZING)


def _looks_through(surface: Mesh, recording: SyntheticSequence) -> NDArray[np.int32]:
    counts, camera = np.zeros(len(surface.vertices), np.int32), recording.camera
    for T_world_camera, depth in _shots(recording):
        T = se3.inverse(T_world_camera)
        points = surface.vertices @ T[:3, :3].T + T[:3, 3]
        rows, u, v = camera.nearest_pixels(points)
        z = points[rows, 2]
        counts[rows] += (z > NEAREST) & (z < FARTHEST) & (depth[v, u] > z + CLEAR)
    return counts


def write_visits(
    recordings: Sequence[SyntheticSequence], truth: Sequence[TrueChange], out: Path, *, overwrite: bool = False
) -> None:
    """Write visit-1, visit-2 and their true changes into a folder.

    Raises:
        DatasetError: A folder has content, or cannot be written.
    """
    for number, recording in enumerate(recordings, start=1):
        write_folder(recording, out / f"visit-{number}", overwrite=overwrite)
    write_text(out / TRUTH, json.dumps([change.tree() for change in truth]) + "\n")
