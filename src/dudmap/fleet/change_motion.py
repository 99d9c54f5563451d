"""Whether a thing that is missing in one place is the one that is new in another: the motion between two surfaces.

Both surfaces are brought together from several turns by the iterative closest point method (to planes; Chen and Medioni
1992), the best few poses are refined on the distances and intensities of both maps (``align_maps``), and the result is
a motion if each surface lies on the other, has its colours, and nothing of it would hang in seen free space.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import agree
from dudmap.fleet.change_evidence import CONFIRMED, Evidence, Visit
from dudmap.fleet.change_objects import Piece
from dudmap.fleet.map_samples import EMPTY, OBSERVED, SurfacePoints, transformed
from dudmap.fleet.sdf_alignment import align_maps

Array = NDArray[np.float64]
TURNS = 16
"""Turns about the vertical from which the surfaces are brought together."""
COARSE, REFINED = 300, 5
"""Points of a surface in the first step, and poses that are refined."""
ICP_ROUNDS = 25
COLOR_LENGTH = 0.3
"""Length that counts as much as the difference of black and white when the nearest point is looked for (Johnson and
Kang 1997), in sizes of the thing."""
COLOR_GATE = 50.0
"""Difference of colours at which points do not meet in the first step, grey levels."""
PULL = 0.05
"""Weight of the distance to a point against that to its plane: holds flat surfaces from sliding."""
MIN_POINTS = 60
"""Points on the other's surface below which the motion is not determined."""
LEAST_FIT, LEAST_SHAPE, LEAST_SEEN = 0.8, 0.6, 0.25
"""Shares of the surface that must lie on the other's: of what would else hang in free space, of what would else hang
there or lie under the other's surface (the back of a thin thing does), and of all of it."""
MAX_COLOR, MAX_CHROMA = (4.0, 0.2), 0.04
"""Largest median difference of the colours after one gain for other light: grey levels and share of the brightness; and
of the shares of red, green and blue."""
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
    def of(cls, found: Evidence, piece: Piece, box: Array) -> "Body":
        """The surface around a piece and in a box (2, 3), without the planes that go on around it."""
        points, margin = found.points, float(np.median(found.tolerance[piece.vertices]))
        wide = np.all((points > box[0] - RING) & (points < box[1] + RING), axis=1)
        inside = np.flatnonzero(wide & np.all((points > box[0] - margin) & (points < box[1] + margin), axis=1))
        around = np.flatnonzero(wide & (found.state == CONFIRMED))
        around = around[~np.isin(around, inside)]
        keep = np.ones(len(inside), bool)
        for normal, offset in _planes(points[around], found.mesh.normals[around].astype(float), margin):
            flat = (np.abs(points[inside] @ normal - offset) < 2 * margin) & (found.mesh.normals[inside] @ normal > 0.8)
            keep &= ~flat
        numbers = np.union1d(inside[keep], piece.vertices)
        denied = np.isin(numbers, piece.vertices)
        mesh = found.mesh
        return cls(
            points[numbers], mesh.normals[numbers].astype(float), mesh.colors[numbers].astype(float), denied, margin
        )

    def chosen(self, rows: NDArray) -> "Body":
        """Some of the points."""
        return Body(self.points[rows], self.normals[rows], self.colors[rows], self.denied[rows], self.tolerance)

    def sample(self, count: int) -> "Body":
        """At most so many points."""
        if len(self.points) <= count:
            return self
        return self.chosen(np.sort(np.random.default_rng(1).choice(len(self.points), count, replace=False)))

    def surface(self, T_map_common: Array) -> SurfacePoints:
        """For ``align_maps``, in the world of its map."""
        grey = (self.colors @ (0.299, 0.587, 0.114) / 255).astype(np.float32)
        n = len(grey)
        return SurfacePoints(
            transformed(T_map_common, self.points), grey, self.colors.astype(np.float32), np.ones(n, bool), 1.0
        )


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
    """A rigid motion (4, 4) of a thing in the common frame, and the share of its surface that fits."""

    T_after_before: Array
    fit: float


def motion_between(before: Visit, after: Visit, missing: Body, new: Body, up: Array) -> Motion | None:
    """The motion that brings the missing surface to the new one, None if they are not one thing.

    ``up`` (3,) is the direction about which things turn most.
    """
    poses = _brought_together(missing.sample(COARSE), new.sample(COARSE), up)
    best: Motion | None = None
    T_a, T_b = before.T_common_map, after.T_common_map
    surfaces = new.sample(4000).surface(se3.inverse(T_b)), missing.sample(4000).surface(se3.inverse(T_a))
    for _, T in [found for found in poses[:REFINED] if found[0] > LEAST_SEEN / 2]:
        aligned = align_maps(
            after.volume, before.volume, *surfaces, se3.inverse(T_b) @ T @ T_a, MIN_POINTS, changed=True
        )
        for candidate in (T_b @ aligned.T_a_b @ se3.inverse(T_a), T):
            fit = _fit(after, missing, new, candidate), _fit(before, new, missing, se3.inverse(candidate))
            if min(fit) > 0 and (best is None or sum(fit) > 2 * best.fit):
                best = Motion(candidate, sum(fit) / 2)
    return best


def _brought_together(a: Body, b: Body, up: Array) -> list[tuple[float, Array]]:
    """Shares of the points that meet, and different motions (4, 4) from a to b, the best first."""
    out: list[tuple[float, Array]] = []
    size = float(np.linalg.norm(np.ptp(b.points, axis=0)))
    shade = COLOR_LENGTH * size / 255
    tree = KDTree(np.hstack([b.points, shade * b.colors]))
    middles = [(body.points.min(axis=0) + body.points.max(axis=0)) / 2 for body in (a, b)]

    def met(T: Array, gate: float) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
        points, normals = transformed(T, a.points), a.normals @ T[:3, :3].T
        near = np.asarray(tree.query(np.hstack([points, shade * a.colors]))[1])
        close = np.linalg.norm(points - b.points[near], axis=1) < gate
        return points, near, close & ((normals * b.normals[near]).sum(axis=1) > 0.5)

    for turn in np.arange(TURNS) * 2 * np.pi / TURNS:
        T = np.eye(4)
        T[:3, :3] = se3.exp_rotation(up * turn)
        T[:3, 3] = middles[1] - T[:3, :3] @ middles[0]
        for step in range(ICP_ROUNDS):
            points, near, use = met(T, max(0.3 * size * 0.85**step, 3 * b.tolerance))
            if use.sum() < 10:
                break
            T = se3.exp(_icp_step(points[use], b.points[near[use]], b.normals[near[use]])) @ T
        _, near, use = met(T, 3 * b.tolerance)
        alike = np.abs(a.colors - b.colors[near]).max(axis=1) < COLOR_GATE
        out.append((float((use & alike).mean()), T))
    out.sort(key=lambda found: -found[0])
    centre = np.eye(4)
    centre[:3, 3] = middles[0]
    kept: list[tuple[float, Array]] = []
    for share, T in out:
        if not any(agree(T @ centre, other @ centre, 0.05, 10.0) for _, other in kept):
            kept.append((share, T))
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


def _fit(there: Visit, own: Body, other: Body, T: Array) -> float:
    """Share of the denied surface of a thing that lies on the other's after a motion; 0 if it does not belong to it."""
    moved = own.chosen(own.denied).sample(1500)
    points, normals = transformed(T, moved.points), moved.normals @ T[:3, :3].T
    gap, near = (np.asarray(found) for found in KDTree(other.points).query(points))
    limit = max(own.tolerance, other.tolerance)
    meets = (gap < limit) & ((normals * other.normals[near]).sum(axis=1) > 0.5)
    samples = there.sample(points)
    known = ~meets & (samples.state == OBSERVED)
    hangs = (~meets & (samples.state == EMPTY)) | (known & (samples.sdf > limit))
    sunk = known & (samples.sdf < -limit)
    fits, seen = int(meets.sum()), int(meets.sum() + hangs.sum())
    if fits < LEAST_FIT * seen or fits < LEAST_SHAPE * (seen + sunk.sum()) or meets.mean() < LEAST_SEEN:
        return 0.0
    return fits / max(seen, 1) if _alike(moved.colors[meets], other.colors[near[meets]]) else 0.0


def _alike(mine: Array, theirs: Array) -> bool:
    """Whether colours (n, 3) of two surfaces are those of one thing, but for one gain."""
    gain = np.clip(np.median(theirs) / max(np.median(mine), 1.0), 0.6, 1.7)
    shares = [np.median((colors + 8) / (colors + 8).sum(axis=1, keepdims=True), axis=0) for colors in (mine, theirs)]
    limit = MAX_COLOR[0] + MAX_COLOR[1] * theirs.mean()
    return bool(np.median(np.abs(gain * mine - theirs)) < limit and np.abs(shares[0] - shares[1]).max() < MAX_CHROMA)
