"""Whether a thing that is missing in one place is the one that is new in another: the motion between two surfaces.

Motions that bring a point onto one of like colour and slope, turned about the vertical, are refined by the iterative
closest point method in both directions (to planes, Chen and Medioni 1992; by colours, Johnson and Kang 1997; at last on
the intensities along the surface, Park et al. 2017). The best is the motion if each surface lies on the other, has its
colours, and nothing of it would hang in seen free space. If others are as good, the smallest turn is taken, and said.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.se3 import agree
from dudmap.fleet.change_evidence import Evidence, Visit
from dudmap.fleet.change_objects import Piece
from dudmap.fleet.map_samples import transformed

Array = NDArray[np.float64]
PAIRS, STARTS, TRIED = 20_000, 400, 12
"""Pairs of points that are drawn, those of a like colour and slope that give a motion, and the best motions that are
registered."""
RANKED, COARSE, FINE, REFINED = 60, 300, 1500, 4
"""Points of a surface in the first step and when a pose is judged, and poses that are refined."""
ICP_ROUNDS, STOP = 12, 1e-3
"""Steps of a registration, and the twist (m, rad) that ends it."""
COLOR_LENGTH = 0.3
"""Length that counts as much as the difference of black and white when the nearest point is looked for (Johnson and
Kang 1997), in sizes of the thing."""
COLOR_GATE = 50.0
"""Difference of colours at which points do not meet in the first step, grey levels."""
COLOR_SCALE = 15.0
"""Difference of colours at which the Cauchy weight of two points that meet falls to a half, grey levels."""
PULL = 0.05
"""Weight of the distance to a point against that to its plane: holds flat surfaces from sliding."""
NEIGHBOURS = 12
"""Points from which the gradient of the intensities along a surface is taken."""
DEVIATIONS, LEAST_NOISE = (2.0, 3.0), (1e-3, 4.0)
"""Standard deviations at which the Geman-McClure weights of distances and intensities fall to a quarter, and the least
that is assumed of each (m, grey levels)."""
LIGHT, DAMPING = 0.2, 0.02
"""Difference of the logarithms of intensities at which the weight falls to a quarter when the light is fitted, and the
weight of its direction per point."""
MIN_POINTS = 60
"""Points on the other's surface below which the motion is not determined."""
LEAST_FIT, LEAST_SEEN = 0.8, 0.25
"""Shares of the surface that must lie on the other's: of what would else hang in free space, and of the larger of both
surfaces."""
PLAIN, MAX_CHROMA = 5.0, 0.04
"""Largest median difference in one light of the colours of a thing without texture, grey levels, and of the shares of
red, green and blue."""
TEXTURE, LEAST_CORRELATION = 8.0, 0.5
"""Standard deviation of the intensities, grey levels, from which on they are a texture, and the least correlation of
two that are one: things of one make have the same texture, any others have about none."""
AS_GOOD, FLAT = 0.9, 0.05
"""Share of the best mean agreement from which on another motion is as good, and the mean square of the normals of what
meets across its two main directions, or of a flat face, from which on it is not known to be the same face."""


@dataclass(frozen=True, eq=False)
class Body:
    """Surface of a thing in one map: what the other map denies, and what is beside it or belongs to it.

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
    def of(cls, found: Evidence, piece: Piece) -> "Body":
        """The surface in the box of a piece; and its length beside it what hangs together with it and the other map
        does not confirm: it may be hidden there."""
        points, margin = found.points, float(np.median(found.tolerance[piece.vertices]))

        def within(far: float) -> NDArray[np.bool_]:
            return np.all((points > piece.box[0] - far) & (points < piece.box[1] + far), axis=1)

        hidden = within(piece.length) & np.isin(found.parts, np.unique(found.parts[piece.vertices]))
        numbers, mesh = np.flatnonzero(within(margin) | hidden), found.mesh
        return cls(
            points[numbers], mesh.normals[numbers].astype(float), mesh.colors[numbers].astype(float),
            np.isin(numbers, piece.vertices), margin,
        )  # fmt: skip

    @cached_property
    def tree(self) -> KDTree:
        """Of the points."""
        return KDTree(self.points)

    @cached_property
    def shades(self) -> Array:
        """Intensities (n,), grey levels."""
        return self.colors.mean(axis=1)

    @cached_property
    def slopes(self) -> Array:
        """Gradients (n, 3) of the intensities along the surface, grey levels per metre, from the nearest points."""
        n, near = self.normals, self.tree.query(self.points, k=min(NEIGHBOURS, len(self.points)))[1]
        apart = self.points[near] - self.points[:, None]
        apart -= np.einsum("nkj,nj,ni->nki", apart, n, n)
        H = np.einsum("nki,nkj->nij", apart, apart) + 1e-6 * np.einsum("ni,nj->nij", n, n) + 1e-7 * np.eye(3)
        g = np.einsum("nki,nk->ni", apart, self.shades[near] - self.shades[:, None])
        return np.asarray(np.linalg.solve(H, g[..., None])[..., 0], np.float64)

    def chosen(self, rows: NDArray) -> "Body":
        """Some of the points."""
        return Body(self.points[rows], self.normals[rows], self.colors[rows], self.denied[rows], self.tolerance)

    def sample(self, count: int) -> "Body":
        """At most so many points."""
        if len(self.points) <= count:
            return self
        return self.chosen(np.sort(np.random.default_rng(1).choice(len(self.points), count, replace=False)))


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a thing.

    Attributes:
        T_after_before: (4, 4), common frame.
        fit: Share of the surface that fits, of what must.
        explained: Vertices of both surfaces that the motion explains, less those that it leaves in free space.
        agreement: The same per vertex.
        ambiguous: Why another motion is as likely, None if there is none.
    """

    T_after_before: Array
    fit: float
    explained: float
    agreement: float
    ambiguous: str | None = None


def motion_between(before: Visit, after: Visit, missing: Body, new: Body, up: Array) -> Motion | None:
    """The motion that brings the missing surface to the new one, None if they are not one thing.

    ``up`` (3,) is the direction about which things turn most.
    """
    coarse, fine = _Meeting(missing, new, COARSE), _Meeting(missing, new, FINE, colored=False)
    starts = coarse.ranked(_starts(coarse.sources[0], coarse.sources[1], up))
    centre = np.eye(4)
    centre[:3, 3] = coarse.sources[0].points.mean(axis=0)
    tried = _different(starts, centre, 0.3 * coarse.size, 20.0)[:TRIED]
    rated = [(coarse.share(T), T) for T in (coarse.registered(T, 0.3 * coarse.size) for T in tried)]
    rated = sorted((row for row in rated if row[0] > LEAST_SEEN / 2), key=lambda row: -row[0])
    first = _different([T for _, T in rated], centre, 0.05, 10.0)[:REFINED]
    judged = [_judged(before, after, missing, new, fine.registered(T, 3 * fine.gate, lit=True)) for T in first]
    motions = sorted((one for one in judged if one is not None), key=lambda one: -one.explained)
    alike = [one for one in motions if one.agreement > AS_GOOD * motions[0].agreement]
    others = len(_different([one.T_after_before for one in alike], centre, 0.3 * coarse.size, 20.0))
    if others > 1:
        smallest = min(alike, key=lambda one: se3.rotation_angle(one.T_after_before))
        return replace(smallest, ambiguous=f"it looks the same after {others} motions; this is the smallest turn")
    return motions[0] if motions else None


class _Meeting:
    """Points of two bodies that lie on each other after a motion from the first to the second.

    Args:
        a, b: The bodies.
        count: Points of the denied surface of each that are looked for on the other, at most.
        colored: Whether like colours are near each other.
    """

    def __init__(self, a: Body, b: Body, count: int, colored: bool = True) -> None:
        self.sources = [body.chosen(body.denied).sample(count) for body in (a, b)]
        self.size = max(float(np.linalg.norm(np.ptp(source.points, axis=0))) for source in self.sources)
        self.gate, self.shade = max(a.tolerance, b.tolerance), colored * COLOR_LENGTH * self.size / 255
        self.others = b, a
        self.trees = [KDTree(np.hstack([body.points, self.shade * body.colors])) for body in self.others]

    def pairs(self, T: Array, gate: float) -> tuple["_Pairs", Array]:
        """What meets within a gate (m) after a motion (4, 4), and the shares of both sources whose points meet any of a
        like colour."""
        rows, shares = [], []
        for own, other, tree, T_own in zip(self.sources, self.others, self.trees, (T, se3.inverse(T)), strict=True):
            points, normals = transformed(T_own, own.points), own.normals @ T_own[:3, :3].T
            far = np.hypot(gate, self.shade * COLOR_GATE * np.sqrt(3))
            near = np.asarray(tree.query(np.hstack([points, self.shade * own.colors]), distance_upper_bound=far)[1])
            known = near < len(other.points)
            near = np.where(known, near, 0)
            use = known & (np.linalg.norm(points - other.points[near], axis=1) < gate)
            use &= (normals * other.normals[near]).sum(axis=1) > 0.5
            shares.append((use & (np.abs(own.colors - other.colors[near]).max(axis=1) < COLOR_GATE)).mean())
            ends = (own, np.flatnonzero(use)), (other, near[use])
            (a, i), (b, j) = ends[::-1] if rows else ends
            rows.append((transformed(T, a.points[i]), a.shades[i], b.points[j], b.normals[j], b.shades[j], b.slopes[j]))
        return _Pairs(*(np.concatenate(part) for part in zip(*rows, strict=True))), np.array(shares)

    def ranked(self, starts: list[Array]) -> list[Array]:
        """Motions (4, 4), those first that bring most of some points of both surfaces near the other's."""
        scores, Ts = np.zeros(len(starts)), np.array(starts).reshape(-1, 4, 4)
        gate = max(0.1 * self.size, 3 * self.gate)
        for own, tree, T in zip(self.sources, self.trees, (Ts, np.linalg.inv(Ts)), strict=True):
            some = own.sample(RANKED)
            points = np.einsum("kij,nj->kni", T[:, :3, :3], some.points) + T[:, None, :3, 3]
            colors = np.broadcast_to(self.shade * some.colors, points.shape)
            gap = tree.query(np.concatenate([points, colors], axis=2).reshape(-1, 6), distance_upper_bound=gate)[0]
            scores += np.isfinite(gap).reshape(len(starts), len(some.points)).mean(axis=1)
        return [starts[n] for n in np.argsort(-scores, kind="stable")]

    def share(self, T: Array) -> float:
        """Mean share of both surfaces that meet the other."""
        return float(self.pairs(T, self.gate)[1].mean())

    def registered(self, T: Array, gate: float, *, lit: bool = False) -> Array:
        """A motion (4, 4) after the iterative closest point method, whose gate (m) shrinks; at last by the intensities
        as well."""
        for _ in range(ICP_ROUNDS):
            pairs = self.pairs(T, max(gate, self.gate))[0]
            if len(pairs.moved) < 10:
                break
            step = pairs.lit_step() if lit else pairs.step()
            T, gate = se3.exp(step) @ T, 0.7 * gate
            if np.linalg.norm(step) < STOP:
                break
        return T


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Moved points (n, 3) of one surface and their intensities (n,), and the points that they meet on the other with
    its normals, intensities and the gradients of these."""

    moved: Array
    mine: Array
    points: Array
    normals: Array
    shades: Array
    slopes: Array

    def step(self) -> Array:
        """Twist (6,) that brings the points to the planes through the others, and a little to them."""
        p, off = self.moved, self.moved - self.points
        J, r = np.hstack([self.normals, np.cross(p, self.normals)]), (off * self.normals).sum(axis=1)
        turned = np.cross(np.eye(3)[None], p[:, None])  # a turn by omega moves a point by omega x p
        pull = PULL * np.concatenate([np.eye(3)[None].repeat(len(p), 0), np.swapaxes(turned, 1, 2)], axis=2)
        H = J.T @ J + np.einsum("nij,nik->jk", pull, pull)
        return -np.linalg.solve(H + 1e-9 * np.eye(6), J.T @ r + np.einsum("nij,ni->j", pull, PULL * off))

    def lit_step(self) -> Array:
        """Twist (6,) that brings the points to the planes through the others and to their intensities, both with
        Geman-McClure weights and by their noise."""
        off, H, g = self.moved - self.points, 1e-9 * np.eye(6), np.zeros(6)
        shade = self.shades + (off * self.slopes).sum(axis=1) - _gains(self.mine, self.shades, self.normals) * self.mine
        rows = (self.normals, (off * self.normals).sum(axis=1)), (self.slopes, shade)
        for (slope, r), deviations, least in zip(rows, DEVIATIONS, LEAST_NOISE, strict=True):
            sigma = max(1.4826 * float(np.median(np.abs(r))), least)
            J = np.hstack([slope, np.cross(self.moved, slope)])
            weighted = J * np.square(1 / sigma / (1 + np.square(r / (deviations * sigma))))[:, None]
            H, g = H + weighted.T @ J, g + weighted.T @ r
        return np.asarray(-np.linalg.solve(H, g), np.float64)


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


def _judged(before: Visit, after: Visit, missing: Body, new: Body, T: Array) -> Motion | None:
    """The motion ``T`` (4, 4) if both surfaces are those of one thing after it, else None."""
    count, mine, theirs, normals = _landed(after, missing, new, T)
    count_back, theirs_back, mine_back, normals_back = _landed(before, new, missing, se3.inverse(T))
    meets, hangs = count + count_back
    most = max(missing.denied.sum(), new.denied.sum())
    if meets < max(LEAST_FIT * (meets + hangs), LEAST_SEEN * most, MIN_POINTS):
        return None
    mine, theirs = np.concatenate([mine, mine_back]), np.concatenate([theirs, theirs_back])
    normals = np.concatenate([normals, normals_back @ T[:3, :3].T])
    lit = _gains(mine.mean(axis=1), theirs.mean(axis=1), normals)[:, None] * mine
    if not _alike(lit, theirs):
        return None
    agree = np.mean(1 / (1 + np.square(np.abs(lit - theirs).max(axis=1) / COLOR_SCALE)))
    explained = float(agree * meets - hangs)
    flat = np.linalg.eigvalsh(normals.T @ normals / len(normals))[1] < FLAT
    ambiguous = "one flat face of it was seen; another may look the same" if flat else None
    return Motion(T, float(meets / (meets + hangs)), explained, explained / (meets + hangs), ambiguous)


def _gains(mine: Array, theirs: Array, normals: Array) -> Array:
    """Gains (n,) from the intensities (n,) of a surface in one light to those in another: their logarithm is linear in
    the normals (n, 3), as light from afar is about (Basri and Jacobs 2003)."""
    A, y = np.hstack([np.ones((len(mine), 1)), normals]), np.log((theirs + 8) / (mine + 8))
    x, damping = np.array([np.median(y), 0, 0, 0]), DAMPING * len(y) * np.diag([0, 1.0, 1, 1])
    for _ in range(3):
        weights = 1 / np.square(1 + np.square((y - A @ x) / LIGHT))
        x = np.linalg.solve((A * weights[:, None]).T @ A + damping, A.T @ (weights * y))
    return np.exp(np.clip(A @ x, -0.7, 0.7))


def _landed(there: Visit, own: Body, other: Body, T: Array) -> tuple[Array, Array, Array, Array]:
    """Numbers (2,) of the denied vertices of a thing that lie on the other's surface after a motion, and that hang in
    free space; colours (n, 3) of some that lie on it and of the other's points, and their normals after it."""
    moved = own.chosen(own.denied).sample(FINE)
    points, normals = transformed(T, moved.points), moved.normals @ T[:3, :3].T
    gap, near = (np.asarray(found) for found in other.tree.query(points))
    limit = max(own.tolerance, other.tolerance)
    meets = (gap < limit) & ((normals * other.normals[near]).sum(axis=1) > 0.5)
    hangs = ~meets & there.sample(points).is_free(limit)
    count = np.array([meets.sum(), hangs.sum()]) * own.denied.sum() / len(points)
    return count, moved.colors[meets], other.colors[near[meets]], normals[meets]


def _alike(mine: Array, theirs: Array) -> bool:
    """Whether colours (n, 3) of two surfaces in one light are those of one thing."""
    shares = [np.median((colors + 8) / (colors + 8).sum(axis=1, keepdims=True), axis=0) for colors in (mine, theirs)]
    if np.abs(shares[0] - shares[1]).max() > MAX_CHROMA:
        return False
    grey = mine.mean(axis=1), theirs.mean(axis=1)
    if min(grey[0].std(), grey[1].std()) < TEXTURE:
        return bool(np.median(np.abs(mine - theirs)) < PLAIN)
    return bool(np.corrcoef(*grey)[0, 1] > LEAST_CORRELATION)
