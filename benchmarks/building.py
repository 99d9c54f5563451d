"""A rendered building of look-alike floors, and short recordings of walks through it, for benchmarks/fleet.py.

Every floor is the same ring of corridors around a core: the same walls with the same textures, panels, doors, signs and
pipes. Only posters and small furniture differ. A lift shaft connects the floors. In every recording somebody walks in
front of the camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.lab.synthetic.furniture import CARDBOARD, DARK_WOOD, METAL, WOOD, plant
from dudmap.lab.synthetic.motion import FloorPath
from dudmap.lab.synthetic.movers import SyntheticMover, person_on
from dudmap.lab.synthetic.person import Figure
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.scene import Light, Material, Primitive, Scene, box, capsule, look_at, pose

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
FPS = 15.0
WIDTH, DEPTH, CORRIDOR, STOREY, CEILING = 12.0, 9.0, 2.4, 3.0, 2.6
"""Outer size of a floor, width of its corridors, height of a storey and of its free space, metres."""
HALF = CORRIDOR / 2
RING = np.array([[HALF, HALF], [WIDTH - HALF, HALF], [WIDTH - HALF, DEPTH - HALF], [HALF, DEPTH - HALF]])
SIDES = np.linalg.norm(np.roll(RING, -1, axis=0) - RING, axis=1)
FLOORS, PLACES = 4, 14
"""Floors, and places around the ring of a floor where a walk begins."""


@dataclass(frozen=True)
class Walk:
    """A recording: on a floor, ``kind`` ring (from place number ``place`` on), entry (from the lift) or lift (up)."""

    kind: str
    floor: int
    place: int = 0

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.kind}-{self.floor}-{self.place:02d}"


def walks(count: int) -> list[Walk]:
    """The first of 64 walks, floor after floor: out of the lift, round the ring, and up to the next floor; 8 are parts
    of two floors."""
    if count == 8:
        names = ("entry", 0, 0), ("ring", 0, 0), ("ring", 0, 1), ("ring", 0, 2), ("lift", 0, 0), ("entry", 1, 0)
        return [Walk(*name) for name in (*names, ("ring", 1, 0), ("ring", 1, 1))]
    out = []
    for floor in range(FLOORS):
        out += [Walk("entry", floor), *[Walk("ring", floor, place) for place in range(PLACES)]]
        out.append(Walk("lift", floor) if floor + 1 < FLOORS else Walk("ring", floor, PLACES))
    return out[:count]


def on_ring(s: float) -> NDArray[np.float64]:
    """Point (2,) of the middle of the corridors, ``s`` metres along the ring."""
    s = s % SIDES.sum()
    side = int(np.searchsorted(np.cumsum(SIDES), s, side="right"))
    start, end = RING[side], RING[(side + 1) % 4]
    return start + (end - start) * (s - SIDES[:side].sum()) / SIDES[side]


def _along_walls(spacing: float, start: float) -> list[tuple[NDArray[np.float64], NDArray[np.float64], bool]]:
    """Points in the middle of the corridor beside straight pieces of wall, direction to the wall, whether it is the
    outer one."""
    out = []
    for s in np.arange(start, SIDES.sum(), spacing):
        a, b = on_ring(s - 0.05), on_ring(s + 0.05)
        tangent = (b - a) / np.linalg.norm(b - a)
        outward = np.array([tangent[1], -tangent[0]])
        middle = on_ring(s)
        out.append((middle, outward, True))
        inner = middle - outward * CORRIDOR * 0.6
        if CORRIDOR < inner[0] < WIDTH - CORRIDOR and CORRIDOR < inner[1] < DEPTH - CORRIDOR:
            out.append((middle, -outward, False))
    return out


def _panel(middle, normal, z, width, height, thickness, material) -> Primitive:
    """Flat box on the wall in direction ``normal`` from the middle of the corridor."""
    at = middle + normal * (HALF - thickness / 2)
    size = (thickness, width, height) if abs(normal[0]) > 0.5 else (width, thickness, height)
    return box((*at, z), size, material)


def _opening(point) -> bool:
    """Whether the wall at a point is (near) the opening to the lift."""
    return point[0] < HALF + 0.1 and point[1] < CORRIDOR + 0.4


def floor_solids(floor: int, layout: int = 0) -> list[Primitive]:
    """All solids of a floor in the frame of the building, without its slabs and lift."""
    rng, z = np.random.default_rng([floor, 77 + layout]), floor * STOREY
    wall, core = Material("wallpaper", (0.5, 0.5)), Material("plaster", (0.5, 0.5), tint=(0.95, 0.92, 0.8))
    middle = z + CEILING / 2
    out = [
        box((WIDTH / 2, -0.1, middle), (WIDTH + 0.4, 0.2, CEILING), wall),
        box((WIDTH / 2, DEPTH + 0.1, middle), (WIDTH + 0.4, 0.2, CEILING), wall),
        box((WIDTH + 0.1, DEPTH / 2, middle), (0.2, DEPTH, CEILING), wall),
        box((-0.1, (2.1 + DEPTH) / 2, middle), (0.2, DEPTH - 2.1, CEILING), wall),
        box((-0.1, 0.15, middle), (0.2, 0.3, CEILING), wall),
        box((-0.1, 1.2, z + 2.45), (0.2, 1.8, 0.3), wall),
        box((WIDTH / 2, DEPTH / 2, middle), (WIDTH - 2 * CORRIDOR, DEPTH - 2 * CORRIDOR, CEILING), core),
        *[capsule((0.3, y, z + 2.45), (WIDTH - 0.3, y, z + 2.45), 0.05, METAL) for y in (0.3, DEPTH - 0.3)],
        *[capsule((x, 0.3, z + 2.4), (x, DEPTH - 0.3, z + 2.4), 0.04, METAL) for x in (WIDTH - 0.3,)],
    ]
    for number, (point, normal, outer) in enumerate(_along_walls(3.24, 2.0)):  # the same on all floors
        if outer and _opening(point):
            continue
        if number % 2:
            out.append(_panel(point, normal, z + 1.0, 0.9, 2.0, 0.04, DARK_WOOD))
        else:
            out.append(_panel(point, normal, z + 1.75, 0.35, 0.35, 0.03, Material("checks", (2.9, 2.9))))
    for number, (point, normal, outer) in enumerate(_along_walls(1.08, 0.9)):
        shape, tint, offset = rng.uniform([0.45, 0.4], [0.85, 0.7]), rng.uniform(0.6, 1.3, 3), rng.uniform(0, 1, 2)
        high, aside = rng.uniform(1.2, 1.85), rng.uniform(-0.15, 0.15)
        if (outer and _opening(point)) or rng.uniform() < 0.15:
            continue
        texture = ("poster", "poster", "books", "plaid", "rug")[number % 5]
        look = Material(texture, tuple(rng.uniform(0.6, 1.0, 2) / shape), tuple(offset), tuple(tint), 0.05, faces=False)
        tangent = np.array([-normal[1], normal[0]])
        out.append(_panel(point + aside * tangent, normal, z + high, *shape, 0.03 + 0.03 * (number % 3), look))
    for number, (point, normal, outer) in enumerate(_along_walls(1.62, 0.5)):
        kind, size, turn = rng.integers(0, 4), rng.uniform(0.25, 0.55, 3), rng.uniform(0, 90)
        if (outer and _opening(point)) or number % 2 == rng.integers(0, 2):
            continue
        x, y = point + normal * (HALF - 0.32)
        if kind == 0:
            out += [part.moved(pose((0, 0, z))) for part in plant((x, y), 0.22)]
        elif kind == 1:
            out.append(box((x, y, z + size[2]), (0.4, 0.4, 2 * size[2]), WOOD, turn))
        else:
            out.append(box((x, y, z + size[2] / 2), (size[0], size[1], size[2]), CARDBOARD, turn))
    return out


def shared_solids() -> list[Primitive]:
    """Slabs between the floors, and the lift shaft."""
    floor, top = Material("checks", (0.4, 0.4)), FLOORS * STOREY
    out = [
        box((WIDTH / 2, DEPTH / 2, k * STOREY - 0.2), (WIDTH + 0.4, DEPTH + 0.4, STOREY - CEILING), floor)
        for k in range(FLOORS + 1)
    ]
    brick = Material("brick", (0.6, 0.6))
    for center, size in (
        ((-2.5, 1.2, top / 2), (0.2, 2.8, top + 1)), ((-1.3, -0.1, top / 2), (2.2, 0.2, top + 1)),
        ((-1.3, 2.5, top / 2), (2.2, 0.2, top + 1)), ((-1.3, 1.2, -0.3), (2.4, 2.4, 0.2)),
        ((-1.3, 1.2, top + 0.3), (2.4, 2.4, 0.2)),
    ):  # fmt: skip
        out.append(box(center, size, brick))
    return out


def building(floors: range = range(FLOORS), layout: int = 0) -> Scene:
    """The building with the furniture of some floors; each ``layout`` has other pictures and other furniture."""
    solids = shared_solids() + [part for floor in floors for part in floor_solids(floor, layout)]
    # light that passes walls and slabs, so that a floor looks the same in all recordings
    lights = (Light((20.0, -15.0, 60.0), 0.45, 0.0), Light((-15.0, 30.0, -40.0), 0.25, 0.0))
    return Scene(
        name="building", primitives=solids, home=look_at((1, 1, 1.5), (4, 1, 1)), target=(4.0, 1.0, 1.0),
        space=((0.3, 0.3, 0.5), (2.0, 2.0, 2.3)), extent=((-2.5, -0.1, -0.1), (WIDTH, DEPTH, FLOORS * STOREY)),
        walk_line=((1, 1), (4, 1)), rest=np.eye(4), hinge=np.eye(4), lights=lights, ambient=0.55,
    )  # fmt: skip


def _poses(walk: Walk, times: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Camera poses (N, 4, 4): a walk of 2.9 m (0.6 m more than to the next place) while the camera turns by 25 degrees
    to either side, a step out of the lift, or a ride up by one storey."""
    share = times / times[-1]
    sway = 0.04 * np.sin(2 * np.pi * (0.35 * times[:, None] + rng.uniform(0, 1, 3)))
    turn = np.radians(rng.permutation([-1, 1])[0] * 25 * np.sin(2 * np.pi * share) + rng.uniform(-6, 6))
    z, spacing = walk.floor * STOREY, SIDES.sum() / PLACES
    out = []
    for k, part in enumerate(share):
        if walk.kind == "ring":
            s = (walk.place + 0.5 * (walk.place >= PLACES)) * spacing + 2.9 * part
            eye = np.array([*on_ring(s), z + 1.5])
            ahead = on_ring(s + 1.8) - eye[:2]
        else:
            eye = np.array([-0.4 if walk.kind == "entry" else -1.2, 1.2, z + 1.45])
            eye += (
                np.array([1.8 * part, 0, 0])
                if walk.kind == "entry"
                else np.array([0, 0, STOREY * (3 * part**2 - 2 * part**3)])
            )
            ahead = np.array([1.8, 0.0])
        angle = turn[k] * (1.0 if walk.kind != "lift" else 0.4)
        c, s = np.cos(angle), np.sin(angle)
        ahead = 2.5 * np.array([c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]]) / np.linalg.norm(ahead)
        target = np.array([*(eye[:2] + ahead), eye[2] - 0.45])
        out.append(look_at(eye + sway[k], target + 0.5 * sway[k]))
    return np.stack(out)


def _walker(walk: Walk, Ts: NDArray[np.float64], duration: float, rng: np.random.Generator) -> SyntheticMover:
    """Somebody who walks round and round a point of the corridor in front of the camera."""
    middle = Ts[len(Ts) // 2]
    center = middle[:2, 3] + 2.3 * middle[:2, 2] / np.linalg.norm(middle[:2, 2])
    if walk.kind == "lift":
        center = np.array([1.3, 1.3])
    low, high = np.array([0.55, 0.55]), np.array([WIDTH - 0.55, DEPTH - 0.55])
    angles = np.arange(0, 40, 0.1) + rng.uniform(0, 6)
    loop = np.clip(center + 0.55 * np.stack([np.cos(angles), np.sin(angles)], axis=1), low, high)
    times = np.arange(len(loop)) * 0.055 / 0.9
    keep = times <= duration + 2.0
    path = FloorPath(list(times[keep] - 1.5), loop[keep].tolist(), smooth=0.1)
    return person_on(path, Figure(rng, int(rng.integers(0, 5))), (walk.floor + (walk.kind == "lift")) * STOREY)


def recording(walk: Walk, layout: int = 0, frames: int = 64) -> SyntheticSequence:
    """The recording of a walk, in the frame of the building; people, path and noise depend on walk and layout."""
    rng = np.random.default_rng([layout, walk.floor, walk.place, ("ring", "entry", "lift").index(walk.kind)])
    times = np.arange(frames) / FPS
    Ts = _poses(walk, times, rng)
    floors = range(walk.floor, walk.floor + 1 + (walk.kind == "lift"))
    return SyntheticSequence(
        building(floors, layout), [_walker(walk, Ts, times[-1], rng)], Trajectory(times, Ts), CAMERA,
        noise="kinect", seed=int(rng.integers(1 << 30)), fps=FPS,
    )  # fmt: skip
