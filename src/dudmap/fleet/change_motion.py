"""Motion of a thing between two visits: from a missing to a new surface.

Start motions bring points onto points of similar colour and slope, turned about the vertical. ICP refines in both
directions, by point-to-plane distances (Chen and Medioni 1992) and intensities (Park et al. 2017), with neighbours by
position and colour (Johnson and Kang 1997) and a prior on tilt.

The score is close surface of similar colours minus surface moved into free space. Motions not significantly worse than
the best make it ambiguous.
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
PAIRS, STARTS = 20_000, 1000
RANKED, COARSE, FINE = 60, 300, 1500
"""Surface points for ranking starts, coarse and fine registration."""
TRIED, REFINED, NEAR, NEAR_DEG = 24, 4, 0.05, 10.0
"""Starts registered coarsely, and finely; distance of one motion (m, degrees)."""
ICP_ROUNDS, STOP = 20, 1e-3
"""Registration steps, and final twist (m, rad)."""
TILT = np.radians(0.3)
"""Standard deviation of a thing's tilt between visits, radians."""
FACE = 0.1
"""Patches that count as one measurement, metres."""
PATCH, DEVIATIONS_APART = 0.05, 2.0
"""Patches with independent scores, metres; standard errors of a significantly worse sum."""
COLOR_LENGTH = 0.3
"""Length of black minus white in the neighbour search (Johnson and Kang 1997), share of the size."""
COLOR_GATE = 50.0
COLOR_SCALE = 15.0
"""Colour difference of Cauchy weight one half, grey levels."""
PULL = 0.05
"""Weight of point-to-point over point-to-plane: flat surfaces do not slide."""
NEIGHBOURS = 12
"""Points for the intensity gradient."""
DEVIATIONS, LEAST_NOISE = (2.0, 3.0), (1e-3, 4.0)
"""Residuals of Geman-McClure weight a quarter, standard deviations, for distances and intensities; smallest standard
deviations (m, grey levels)."""
LIGHT, DAMPING = 0.2, 0.02
"""Log intensity difference of weight a quarter; damping of the light's direction per point."""
MIN_POINTS = 60
"""Fewest matched points of a motion."""
LEAST_FIT, LEAST_SEEN, LEAST_EXPLAINED = 0.8, 0.25, 0.05
"""Smallest matched share of surface that matches or lies in free space, of the larger body; smallest explained share of
the former."""
PLAIN, MAX_CHROMA = 5.0, 0.04
"""Median colour difference of an untextured thing, grey levels; difference of the shares of red, green and blue."""
TEXTURE, LEAST_CORRELATION = 8.0, 0.5
"""Standard deviation of a texture's intensities, grey levels; smallest correlation of equal textures."""
FLAT = 0.05
"""Second eigenvalue of the mean outer product of normals of one flat face."""


@dataclass(frozen=True, eq=False)
class Body:
    """Surface of a thing in one map: its denied part and surroundings.

    Attributes:
        points, normals: (n, 3) float64, common frame.
        colors: (n, 3) float64, 0..255.
        denied: (n,) bool.
        tolerance: Noise, metres.
    """

    points: Array
    normals: Array
    colors: Array
    denied: NDArray[np.bool_]
    tolerance: float

    @classmethod
    def of(cls, found: Evidence, piece: Piece) -> "Body":
        """Surface in a piece's box, and connected points within its length, perhaps hidden in the other map."""
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
        """Tree of the points."""
        return KDTree(self.points)

    @cached_property
    def shades(self) -> Array:
        """Intensities (n,), grey levels."""
        return self.colors.mean(axis=1)

    @cached_property
    def slopes(self) -> Array:
        """Intensity gradients (n, 3) along the surface, grey levels per metre."""
        n, near = self.normals, self.tree.query(self.points, k=min(NEIGHBOURS, len(self.points)))[1]
        apart = self.points[near] - self.points[:, None]
        apart -= np.einsum("nkj,nj,ni->nki", apart, n, n)
        H = np.einsum("nki,nkj->nij", apart, apart) + 1e-6 * np.einsum("ni,nj->nij", n, n) + 1e-7 * np.eye(3)
        g = np.einsum("nki,nk->ni", apart, self.shades[near] - self.shades[:, None])
        return np.asarray(np.linalg.solve(H, g[..., None])[..., 0], np.float64)

    def chosen(self, rows: NDArray) -> "Body":
        """Select points."""
        return Body(self.points[rows], self.normals[rows], self.colors[rows], self.denied[rows], self.tolerance)

    def sample(self, count: int) -> "Body":
        """Select at most ``count`` random points."""
        if len(self.points) <= count:
            return self
        return self.chosen(np.sort(np.random.default_rng(1).choice(len(self.points), count, replace=False)))


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a thing.

    Attributes:
        T_after_before: (4, 4), common frame.
        fit: Matched share of the surface that matches or lies in free space.
        explained: Vertices of both surfaces explained minus moved into free space.
        scores: (n,) ``explained`` per patch.
        is_likely: Whether both may be one thing.
        ambiguous: Why another motion is equally likely, else None.
        sigma: Standard deviations of the centre (m) and rotation (rad).
    """

    T_after_before: Array
    fit: float
    explained: float
    scores: Array
    is_likely: bool
    ambiguous: str | None = None
    sigma: tuple[float, float] = (np.inf, np.inf)

    def is_worse(self, best: "Motion") -> bool:
        """Whether it explains significantly less (paired t-test over patches)."""
        less = best.scores - self.scores
        return bool(less.sum() > DEVIATIONS_APART * np.sqrt(len(less)) * less.std())


def motion_between(before: Visit, after: Visit, missing: Body, new: Body, up: Array) -> Motion | None:
    """Motion from the missing to the new surface; None if they are not one thing. ``up`` (3,): vertical."""
    coarse, fine = (_Meeting((after, before), (missing, new), up, count) for count in (COARSE, FINE))

    def judged(meeting: _Meeting, starts: list[Array], gate: float) -> list[Motion]:
        found = [meeting.judged(meeting.registered(T, gate)) for T in starts]
        return sorted((one for one in found if one is not None), key=lambda one: -one.explained)

    tried = coarse.different(coarse.starts(), 0.2 * coarse.size, 2 * NEAR_DEG)[:TRIED]
    rated = [one.T_after_before for one in judged(coarse, tried, 0.3 * coarse.size) if one.explained > 0]
    found = judged(fine, coarse.different(rated, 0.2 * coarse.size, NEAR_DEG)[:REFINED], 3 * fine.gate)
    likely = [one for one in found if one.is_likely]
    if not likely:
        return None
    alike = [likely[0], *(one for one in found if not one.is_worse(likely[0]))]
    others = len(coarse.different([one.T_after_before for one in alike], NEAR, NEAR_DEG))
    best, ambiguous = likely[0], likely[0].ambiguous
    if others > 1:
        best = min((one for one in alike if one.is_likely), key=lambda one: se3.rotation_angle(one.T_after_before))
        ambiguous = f"it looks the same after {others} motions; this is the smallest turn"
    return replace(best, ambiguous=ambiguous, sigma=fine.sigma(best.T_after_before))


class _Meeting:
    """Matched points of two bodies under a motion.

    Args:
        up: (3,) axis of turns.
        count: Matched points of each denied surface.
    """

    def __init__(self, there: tuple[Visit, Visit], bodies: tuple[Body, Body], up: Array, count: int) -> None:
        self.there, self.others, self.up = there, bodies[::-1], up
        denied = [body.chosen(body.denied) for body in bodies]
        self.sources = [body.sample(count) for body in denied]
        self.most = max(len(body.points) for body in denied)
        self.weights = np.concatenate(
            [np.full(len(b.points), len(a.points) / len(b.points)) for a, b in zip(denied, self.sources, strict=True)]
        )
        cells = [np.insert(np.floor(body.points / PATCH), 0, n, axis=1) for n, body in enumerate(self.sources)]
        self.patches = np.unique(np.concatenate(cells), axis=0, return_inverse=True)[1].reshape(-1)
        self.size = max(float(np.linalg.norm(np.ptp(source.points, axis=0))) for source in self.sources)
        self.gate, self.shade = max(body.tolerance for body in bodies), COLOR_LENGTH * self.size / 255
        self.trees = [KDTree(np.hstack([body.points, self.shade * body.colors])) for body in self.others]

    def starts(self) -> list[Array]:
        """Candidate motions (4, 4), most points with a neighbour first.

        Each matches one point of similar colour; normals, or chance for vertical ones, give the turn.
        """
        (a, b), up, rng, out = self.sources, self.up, np.random.default_rng(1), list[Array]()
        gate = max(0.1 * self.size, 3 * self.gate)
        rows, columns = rng.integers(len(a.points), size=PAIRS), rng.integers(len(b.points), size=PAIRS)
        like = np.abs(a.colors[rows] - b.colors[columns]).max(axis=1) < COLOR_GATE
        rises = a.normals[rows] @ up, b.normals[columns] @ up
        use = np.flatnonzero(like & (np.abs(rises[0] - rises[1]) < 0.3))[:STARTS]
        for row, column, rise in zip(rows[use], columns[use], rises[0][use], strict=True):
            n, m = a.normals[row], b.normals[column]
            turn = np.arctan2(up @ np.cross(n, m), n @ m - (up @ n) * (up @ m))
            if abs(rise) > 0.9:
                turn = rng.uniform(-np.pi, np.pi)
            T = np.eye(4)
            T[:3, :3] = se3.exp_rotation(up * turn)
            T[:3, 3] = b.points[column] - T[:3, :3] @ a.points[row]
            out.append(T)
        scores, Ts = np.zeros(len(out)), np.array(out).reshape(-1, 4, 4)
        for own, tree, T in zip(self.sources, self.trees, (Ts, np.linalg.inv(Ts)), strict=True):
            some = own.sample(RANKED)
            points = np.einsum("kij,nj->kni", T[:, :3, :3], some.points) + T[:, None, :3, 3]
            colors = np.broadcast_to(self.shade * some.colors, points.shape)
            gap = tree.query(np.concatenate([points, colors], axis=2).reshape(-1, 6), distance_upper_bound=gate)[0]
            scores += np.isfinite(gap).reshape(len(out), len(some.points)).mean(axis=1)
        return [out[n] for n in np.argsort(-scores, kind="stable")]

    def different(self, poses: list[Array], distance: float, angle_deg: float) -> list[Array]:
        """Motions (4, 4) without later ones of about the same pose."""
        centre, kept = np.eye(4), list[Array]()
        centre[:3, 3] = self.sources[0].points.mean(axis=0)
        for T in poses:
            if not any(agree(T @ centre, other @ centre, distance, angle_deg) for other in kept):
                kept.append(T)
        return kept

    def registered(self, T: Array, gate: float) -> Array:
        for _ in range(ICP_ROUNDS):
            pairs = self._pairs(T, max(gate, self.gate))
            if len(pairs.moved) < 10:
                break
            H, g = self._normal_equations(pairs, T)
            step = np.asarray(-np.linalg.solve(H, g), np.float64)
            T, gate = se3.exp(step) @ T, 0.7 * gate
            if np.linalg.norm(step) < STOP:
                break
        return T

    def sigma(self, T: Array) -> tuple[float, float]:
        pairs, about = self._pairs(T, self.gate), np.eye(6)
        about[:3, 3:] = se3.hat(pairs.moved.mean(axis=0))
        variances = np.diag(np.linalg.inv(about.T @ self._normal_equations(pairs, T)[0] @ about))
        return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))

    def _pairs(self, T: Array, gate: float) -> "_Pairs":
        rows = []
        for own, other, tree, T_own in zip(self.sources, self.others, self.trees, (T, se3.inverse(T)), strict=True):
            points, normals = transformed(T_own, own.points), own.normals @ T_own[:3, :3].T
            far = np.hypot(gate, self.shade * COLOR_GATE * np.sqrt(3))
            near = np.asarray(tree.query(np.hstack([points, self.shade * own.colors]), distance_upper_bound=far)[1])
            known = near < len(other.points)
            near = np.where(known, near, 0)
            use = known & (np.linalg.norm(points - other.points[near], axis=1) < gate)
            use &= (normals * other.normals[near]).sum(axis=1) > 0.5
            ends = (own, np.flatnonzero(use)), (other, near[use])
            (a, i), (b, j) = ends[::-1] if rows else ends
            rows.append((transformed(T, a.points[i]), a.shades[i], b.points[j], b.normals[j], b.shades[j], b.slopes[j]))
        return _Pairs(*(np.concatenate(part) for part in zip(*rows, strict=True)))

    def _normal_equations(self, pairs: "_Pairs", T: Array) -> tuple[Array, Array]:
        H, g = pairs.normal_equations()
        tilt, level = np.cross(self.up, T[:3, :3] @ self.up), np.eye(3) - np.outer(self.up, self.up)
        weight = np.square(1 / TILT / (1 + np.square(np.linalg.norm(tilt) / (DEVIATIONS[0] * TILT))))
        H[3:, 3:] += weight * level
        g[3:] += weight * tilt
        return H, g

    def judged(self, T: Array) -> Motion | None:
        """Score the motion ``T`` (4, 4); None if hardly a point matches."""
        rows = []
        for own, other, there, T_own in zip(self.sources, self.others, self.there, (T, se3.inverse(T)), strict=True):
            points, normals = transformed(T_own, own.points), own.normals @ T_own[:3, :3].T
            gap, near = (np.asarray(found) for found in other.tree.query(points))
            meets = (gap < self.gate) & ((normals * other.normals[near]).sum(axis=1) > 0.5)
            hangs = ~meets & there.sample(points).is_free(self.gate)
            off = ((points - other.points[near]) * other.normals[near]).sum(axis=1)
            after = own.normals if rows else normals
            rows.append((meets, hangs, off, own.colors, other.colors[near], after))
        meets, hangs, off, mine, theirs, normals = (np.concatenate(part) for part in zip(*rows, strict=True))
        if meets.sum() < 10:
            return None
        mine, theirs, normals = mine[meets], theirs[meets], normals[meets]
        lit = _gains(mine.mean(axis=1), theirs.mean(axis=1), normals)[:, None] * mine
        agreement = 1 / (1 + np.square(np.abs(lit - theirs).max(axis=1) / COLOR_SCALE))
        scores = -self.weights * hangs
        scores[meets] = self.weights[meets] * agreement / (1 + np.square(2 * off[meets] / self.gate))
        on, free, explained = float(self.weights @ meets), float(self.weights @ hangs), float(scores.sum())
        is_likely = on > max(LEAST_FIT * (on + free), LEAST_SEEN * self.most, MIN_POINTS)
        is_likely &= explained > LEAST_EXPLAINED * (on + free) and _alike(lit, theirs, self.patches[meets])
        patches = np.asarray(np.bincount(self.patches, scores), np.float64)
        flat = np.linalg.eigvalsh(normals.T @ normals / len(normals))[1] < FLAT
        ambiguous = "one flat face of it was seen; another may look the same" if flat else None
        return Motion(T, on / (on + free), explained, patches, is_likely, ambiguous)


@dataclass(frozen=True, eq=False)
class _Pairs:
    moved: Array
    mine: Array
    points: Array
    normals: Array
    shades: Array
    slopes: Array

    def normal_equations(self) -> tuple[Array, Array]:
        off, H, g = self.moved - self.points, 1e-9 * np.eye(6), np.zeros(6)
        share = len(np.unique(np.floor(self.moved / FACE), axis=0)) / len(self.moved)
        shade = self.shades + (off * self.slopes).sum(axis=1) - _gains(self.mine, self.shades, self.normals) * self.mine
        rows = (self.normals, (off * self.normals).sum(axis=1)), (self.slopes, shade)
        terms = []
        for (slope, r), deviations, least in zip(rows, DEVIATIONS, LEAST_NOISE, strict=True):
            sigma = max(1.4826 * float(np.median(np.abs(r))), least)
            terms.append((slope, r, np.square(1 / sigma / (1 + np.square(r / (deviations * sigma))))))
        pull = np.square(PULL) / max(float(np.mean(np.square(off))), LEAST_NOISE[0] ** 2)
        terms += [(np.tile(axis, (len(off), 1)), off @ axis, np.full(len(off), pull)) for axis in np.eye(3)]
        for slope, r, weights in terms:
            J = np.hstack([slope, np.cross(self.moved, slope)])
            weighted = J * (share * weights)[:, None]
            H, g = H + weighted.T @ J, g + weighted.T @ r
        return H, g


def _gains(mine: Array, theirs: Array, normals: Array) -> Array:
    """Gains from one light to another, log-linear in the normals (Basri and Jacobs 2003)."""
    A, y = np.hstack([np.ones((len(mine), 1)), normals]), np.log((theirs + 8) / (mine + 8))
    x, damping = np.array([np.median(y), 0, 0, 0]), DAMPING * len(y) * np.diag([0, 1.0, 1, 1])
    for _ in range(3):
        weights = 1 / np.square(1 + np.square((y - A @ x) / LIGHT))
        x = np.linalg.solve((A * weights[:, None]).T @ A + damping, A.T @ (weights * y))
    return np.exp(np.clip(A @ x, -0.7, 0.7))


def _alike(mine: Array, theirs: Array, patches: NDArray[np.intp]) -> bool:
    """Whether two surfaces have one thing's colours, averaged over patches."""
    patches, counts = np.unique(patches, return_inverse=True, return_counts=True)[1:]
    mine, theirs = (
        np.stack([np.bincount(patches, x) for x in colors.T], axis=1) / counts[:, None] for colors in (mine, theirs)
    )
    shares = [np.median((colors + 8) / (colors + 8).sum(axis=1, keepdims=True), axis=0) for colors in (mine, theirs)]
    if np.abs(shares[0] - shares[1]).max() > MAX_CHROMA:
        return False
    grey = mine.mean(axis=1), theirs.mean(axis=1)
    spread = min(grey[0].std(), grey[1].std())
    is_plain = spread < TEXTURE and np.median(np.abs(mine - theirs)) < PLAIN
    return bool(is_plain or (spread > 0 and np.corrcoef(*grey)[0, 1] > LEAST_CORRELATION))
