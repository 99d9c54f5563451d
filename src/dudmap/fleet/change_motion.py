"""Whether a thing that is missing in one place is the one that is new in another: the motion between two surfaces.

Motions that bring a point onto one of like colour and slope, turned about the vertical, are refined by the iterative
closest point method in both directions (to planes, Chen and Medioni 1992; by colours, Johnson and Kang 1997). The best
is the motion if each surface lies on the other, has its colours, and nothing of it would hang in seen free space.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.se3 import agree
from dudmap.fleet.change_evidence import CONFIRMED, Evidence, Visit
from dudmap.fleet.change_objects import Piece
from dudmap.fleet.map_samples import EMPTY, OBSERVED, transformed

Array = NDArray[np.float64]
PAIRS, STARTS, TRIED = 20_000, 400, 12
"""Pairs of points that are drawn, those of a like colour and slope that give a motion, and the best motions that are
registered."""
COARSE, FINE, REFINED = 300, 1500, 4
"""Points of a surface in the first step and when a pose is judged, and poses that are refined."""
ICP_ROUNDS, STOP = 25, 1e-3
"""Steps of a registration, and the twist (m, rad) that ends it."""
COLOR_LENGTH = 0.3
"""Length that counts as much as the difference of black and white when the nearest point is looked for (Johnson and
Kang 1997), in sizes of the thing."""
COLOR_GATE = 50.0
"""Difference of colours at which points do not meet in the first step, grey levels."""
COLOR_SCALE = 15.0
"""Difference of colours at which the Geman-McClure weight of two points that meet falls to a quarter, grey levels."""
PULL = 0.05
"""Weight of the distance to a point against that to its plane: holds flat surfaces from sliding."""
MIN_POINTS = 60
"""Points on the other's surface below which the motion is not determined."""
LEAST_FIT, LEAST_SHAPE, LEAST_SEEN = 0.8, 0.6, 0.25
"""Shares of the surface that must lie on the other's: of what would else hang in free space, of what would else hang
there or lie under the other's surface (the back of a thin thing does), and of the smaller of both surfaces."""
MAX_COLOR, MAX_CHROMA = (4.0, 0.2), 0.04
"""Largest median difference of the colours after one gain for other light: grey levels and share of the brightness; and
of the shares of red, green and blue."""
TEXTURE, LEAST_CORRELATION = 8.0, 0.5
"""Standard deviation of the intensities, grey levels, from which on they are a texture, and the least correlation of
two that are one: things of one make have the same texture, any others have about none."""
RING = 0.15
"""Width of the ring around a thing in which the planes that it stands on are looked for, metres."""
LEAST_PLANE = 0.15
"""Share of the surface in that ring from which on a plane is what a thing stands on or before."""


@dataclass(frozen=True, eq=False)
class Body:
    """Surface of a thing in one map: what the other map denies, and what belongs to it and is no background.

    Attributes:
        points, normals: (n, 3) float64, common frame.
        colors: (n, 3) float64, 0..255.
        denied: (n,) bool, the part that the other map denies.
        tolerance: Distance that noise explains, metres.
    """

    points: Array
    normals: Array
    colors: Array
    denied: NDArray[np.bool_]
    tolerance: float

    @classmethod
    def of(cls, found: Evidence, piece: Piece, box: Array, reach: float) -> "Body":
        """The surface around a piece and in a box (2, 3), without the planes that go on around it; and so far (m) from
        the box what hangs together with the piece and the other map does not confirm: it may be hidden there."""
        points, margin = found.points, float(np.median(found.tolerance[piece.vertices]))

        def within(far: float) -> NDArray[np.bool_]:
            return np.all((points > box[0] - far) & (points < box[1] + far), axis=1)

        wide, near = within(RING), within(margin)
        hidden = within(reach) & np.isin(found.parts, np.unique(found.parts[piece.vertices]))
        inside = np.flatnonzero((near & wide) | hidden)
        around = np.flatnonzero(wide & (found.state == CONFIRMED) & ~near)
        keep = np.ones(len(inside), bool)
        for normal, offset in _planes(points[around], found.mesh.normals[around].astype(float), margin):
            flat = (np.abs(points[inside] @ normal - offset) < 2 * margin) & (found.mesh.normals[inside] @ normal > 0.8)
            keep &= ~flat
        numbers = np.union1d(inside[keep], piece.vertices)
        denied, mesh = np.isin(numbers, piece.vertices), found.mesh
        return cls(
            points[numbers], mesh.normals[numbers].astype(float), mesh.colors[numbers].astype(float), denied, margin
        )

    @cached_property
    def tree(self) -> KDTree:
        """Of the points."""
        return KDTree(self.points)

    def chosen(self, rows: NDArray) -> "Body":
        """Some of the points."""
        return Body(self.points[rows], self.normals[rows], self.colors[rows], self.denied[rows], self.tolerance)

    def sample(self, count: int) -> "Body":
        """At most so many points."""
        if len(self.points) <= count:
            return self
        return self.chosen(np.sort(np.random.default_rng(1).choice(len(self.points), count, replace=False)))


def _planes(points: Array, normals: Array, margin: float) -> list[tuple[Array, float]]:
    """Normals (3,) and offsets of up to three planes that hold a share of some surface (n, 3)."""
    out, left = [], np.ones(len(points), bool)
    tried = np.random.default_rng(1).permutation(len(points))[:100]
    for _ in range(3):
        best = None
        for number in tried:
            on = (
                left
                & (np.abs((points - points[number]) @ normals[number]) < margin)
                & (normals @ normals[number] > 0.9)
            )
            if best is None or on.sum() > best.sum():
                best = on
        if best is None or best.sum() < max(LEAST_PLANE * len(points), 10):
            break
        normal = normals[best].mean(axis=0)
        normal /= np.linalg.norm(normal)
        out.append((normal, float(np.median(points[best] @ normal))))
        left &= ~best
    return out


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a thing.

    Attributes:
        T_after_before: (4, 4), common frame.
        fit: Share of the surface that fits, of what must.
        explained: Vertices of both surfaces that the motion explains, less those that it leaves in free space.
    """

    T_after_before: Array
    fit: float
    explained: float


def motion_between(before: Visit, after: Visit, missing: Body, new: Body, up: Array) -> Motion | None:
    """The motion that brings the missing surface to the new one, None if they are not one thing.

    ``up`` (3,) is the direction about which things turn most.
    """
    coarse, fine = (_Meeting(missing, new, count) for count in (COARSE, FINE))
    a, b = coarse.sources
    starts = sorted(_starts(a, b, up), key=lambda T: -coarse.share(T, max(0.1 * coarse.size, 3 * coarse.gate)))
    centre = np.eye(4)
    centre[:3, 3] = a.points.mean(axis=0)
    first = [
        coarse.registered(T, 0.3 * coarse.size) for T in _different(starts, centre, 0.3 * coarse.size, 20.0)[:TRIED]
    ]
    first = [T for T in first if coarse.share(T, coarse.gate) > LEAST_SEEN / 2]
    first = _different(sorted(first, key=lambda T: -coarse.share(T, coarse.gate)), centre, 0.05, 10.0)
    motions = [_judged(before, after, missing, new, fine.registered(T, 3 * fine.gate)) for T in first[:REFINED]]
    return max((one for one in motions if one is not None), key=lambda one: one.explained, default=None)


class _Meeting:
    """Points of two bodies that lie on each other after a motion from the first to the second.

    Args:
        a, b: The bodies.
        count: Points of the denied surface of each that are looked for on the other, at most.
    """

    def __init__(self, a: Body, b: Body, count: int) -> None:
        self.sources = [body.chosen(body.denied).sample(count) for body in (a, b)]
        self.size = max(float(np.linalg.norm(np.ptp(source.points, axis=0))) for source in self.sources)
        self.gate, self.shade = max(a.tolerance, b.tolerance), COLOR_LENGTH * self.size / 255
        self.others = b, a
        self.trees = [KDTree(np.hstack([body.points, self.shade * body.colors])) for body in self.others]

    def pairs(self, T: Array, gate: float) -> tuple[Array, Array, Array, Array]:
        """Points (n, 3) of a after a motion (4, 4), those of b that they meet within a gate (m) and the normals there;
        and the shares of both sources whose points meet any of a like colour."""
        rows, shares = [], []
        for own, other, tree, T_own in zip(self.sources, self.others, self.trees, (T, se3.inverse(T)), strict=True):
            points, normals = transformed(T_own, own.points), own.normals @ T_own[:3, :3].T
            near = np.asarray(tree.query(np.hstack([points, self.shade * own.colors]))[1])
            use = np.linalg.norm(points - other.points[near], axis=1) < gate
            use &= (normals * other.normals[near]).sum(axis=1) > 0.5
            shares.append((use & (np.abs(own.colors - other.colors[near]).max(axis=1) < COLOR_GATE)).mean())
            met = other.points[near[use]]
            ends = (transformed(T, met), own.points[use], own.normals[use]) if rows else (
                points[use], met, other.normals[near[use]],
            )  # fmt: skip
            rows.append(ends)
        p, q, n = (np.concatenate(part) for part in zip(*rows, strict=True))
        return p, q, n, np.array(shares)

    def share(self, T: Array, gate: float) -> float:
        """Mean share of both surfaces that meet the other."""
        return float(self.pairs(T, gate)[3].mean())

    def registered(self, T: Array, gate: float) -> Array:
        """A motion (4, 4) after the iterative closest point method, whose gate (m) shrinks."""
        for _ in range(ICP_ROUNDS):
            p, q, n, _ = self.pairs(T, max(gate, self.gate))
            if len(p) < 10:
                break
            step = _icp_step(p, q, n)
            T, gate = se3.exp(step) @ T, 0.85 * gate
            if np.linalg.norm(step) < STOP:
                break
        return T


def _starts(a: Body, b: Body, up: Array) -> list[Array]:
    """Motions (4, 4) that bring a point of a onto one of b with a like colour: the turn about the vertical is that
    between their normals, and any where these are vertical."""
    rng = np.random.default_rng(1)
    rows, columns = rng.integers(len(a.points), size=PAIRS), rng.integers(len(b.points), size=PAIRS)
    like = np.abs(a.colors[rows] - b.colors[columns]).max(axis=1) < COLOR_GATE
    rises = a.normals[rows] @ up, b.normals[columns] @ up
    use = np.flatnonzero(like & (np.abs(rises[0] - rises[1]) < 0.3))[:STARTS]
    out = []
    for row, column, rise in zip(rows[use], columns[use], rises[0][use], strict=True):
        n, m = a.normals[row], b.normals[column]
        turn = np.arctan2(up @ np.cross(n, m), n @ m - (up @ n) * (up @ m))
        if abs(rise) > 0.9:
            turn = rng.uniform(-np.pi, np.pi)
        T = np.eye(4)
        T[:3, :3] = se3.exp_rotation(up * turn)
        T[:3, 3] = b.points[column] - T[:3, :3] @ a.points[row]
        out.append(T)
    return out


def _different(poses: list[Array], centre: Array, distance: float, angle_deg: float) -> list[Array]:
    """The first of all poses (4, 4) that bring a centre (4, 4) to about the same place."""
    kept: list[Array] = []
    for T in poses:
        if not any(agree(T @ centre, other @ centre, distance, angle_deg) for other in kept):
            kept.append(T)
    return kept


def _icp_step(p: Array, q: Array, n: Array) -> Array:
    """Twist (6,) that brings points (k, 3) to planes through others with normals n, and a little to them."""
    J = np.hstack([n, np.cross(p, n)])
    r = ((p - q) * n).sum(axis=1)
    turned = np.cross(np.eye(3)[None], p[:, None])  # a turn by omega moves a point by omega x p
    pull = PULL * np.concatenate([np.eye(3)[None].repeat(len(p), 0), np.swapaxes(turned, 1, 2)], axis=2)
    H = J.T @ J + np.einsum("nij,nik->jk", pull, pull)
    g = J.T @ r + np.einsum("nij,ni->j", pull, PULL * (p - q))
    return -np.linalg.solve(H + 1e-9 * np.eye(6), g)


def _judged(before: Visit, after: Visit, missing: Body, new: Body, T: Array) -> Motion | None:
    """The motion ``T`` (4, 4) if both surfaces are those of one thing after it, else None."""
    sides = _landed(after, missing, new, T), _landed(before, new, missing, se3.inverse(T))
    meets, hangs, sunk = np.sum([side.count for side in sides], axis=0)
    fewest = min(missing.denied.sum(), new.denied.sum())
    if meets < max(LEAST_FIT * (meets + hangs), LEAST_SHAPE * (meets + hangs + sunk), LEAST_SEEN * fewest, MIN_POINTS):
        return None
    mine = np.concatenate([sides[0].own, sides[1].other])
    theirs = np.concatenate([sides[0].other, sides[1].own])
    gain = np.clip(np.median(theirs) / max(np.median(mine), 1.0), 0.6, 1.7)
    if not _alike(mine, theirs, gain):
        return None
    agree = np.mean(1 / np.square(1 + np.square(np.abs(gain * mine - theirs).max(axis=1) / COLOR_SCALE)))
    return Motion(T, float(meets / (meets + hangs)), float(agree * meets - hangs))


@dataclass(frozen=True, eq=False)
class _Landed:
    """Numbers of the denied vertices of a thing that lie on the other's surface after a motion, hang in free space or
    lie under the other's surface; colours (n, 3) of some that lie on it, and of the other's points there."""

    count: Array
    own: Array
    other: Array


def _landed(there: Visit, own: Body, other: Body, T: Array) -> _Landed:
    moved = own.chosen(own.denied).sample(FINE)
    points, normals = transformed(T, moved.points), moved.normals @ T[:3, :3].T
    gap, near = (np.asarray(found) for found in other.tree.query(points))
    limit = max(own.tolerance, other.tolerance)
    meets = (gap < limit) & ((normals * other.normals[near]).sum(axis=1) > 0.5)
    samples = there.sample(points)
    known = ~meets & (samples.state == OBSERVED)
    hangs = (~meets & (samples.state == EMPTY)) | (known & (samples.sdf > limit))
    sunk = known & (samples.sdf < -limit)
    each = own.denied.sum() / len(points)
    count = each * np.array([meets.sum(), hangs.sum(), sunk.sum()])
    return _Landed(count, moved.colors[meets], other.colors[near[meets]])


def _alike(mine: Array, theirs: Array, gain: float) -> bool:
    """Whether colours (n, 3) of two surfaces are those of one thing, but for a gain."""
    shares = [np.median((colors + 8) / (colors + 8).sum(axis=1, keepdims=True), axis=0) for colors in (mine, theirs)]
    if np.abs(shares[0] - shares[1]).max() > MAX_CHROMA:
        return False
    if np.median(np.abs(gain * mine - theirs)) > MAX_COLOR[0] + MAX_COLOR[1] * theirs.mean():
        return False
    grey = mine.mean(axis=1), theirs.mean(axis=1)
    return bool(min(grey[0].std(), grey[1].std()) < TEXTURE or np.corrcoef(*grey)[0, 1] > LEAST_CORRELATION)
