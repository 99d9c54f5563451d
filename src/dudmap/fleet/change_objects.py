"""Group denied surface into things; select certain and recoloured ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, KDTree

from dudmap.fleet.change_evidence import CONFIRMED, DENIED, Evidence, Visit, components, surface_tree

LINK = 4.0
"""Gap within a thing, voxels."""
REACH = 0.5
"""Gap between parts without observed free space, in lengths of the larger piece."""
SLIM, OUTLINE = 0.5, 1.1
"""Width of a leg over its height; factor of a thing's outline."""
LEAST_FACE = 0.3
"""Area of a change in squares of the smallest size."""
LEAST_FACING = 0.1
"""Median cosine between a change's normals and the best keyframe's ray."""
LEAST_COVER = 0.125
"""Share of its box's larger face that a change fills, unlike edge fragments."""
CLEAR = 2.0
"""Median gap of a change, noise tolerances."""
CERTAIN = 3
"""Median weight of a certain change, smallest mesh weights."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Connected surface of one map that the other denies.

    Attributes:
        vertices: (n,) int, vertices of the mesh.
        points: (n, 3) float64, metres, common frame.
        area: Square metres.
    """

    vertices: NDArray[np.intp]
    points: NDArray[np.float64]
    area: float

    @property
    def box(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 3)."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])

    @property
    def length(self) -> float:
        """Diagonal of the box, metres."""
        return float(np.linalg.norm(self.box[1] - self.box[0]))


def denied_pieces(found: Evidence, voxel_size: float, min_size: float) -> list[Piece]:
    """Pieces of denied surface, largest first, without small ones."""
    pieces = connected(found, opened(found, found.state == DENIED), LINK * voxel_size)
    return [piece for piece in pieces if piece.area > LEAST_FACE * min_size**2]


def assembled(pieces: list[Piece], own: Visit, up: NDArray[np.float64]) -> list[Piece]:
    """Join pieces with smaller parts and thin legs, largest first. Parts were occluded in between."""
    out: list[Piece] = []
    for piece in sorted(pieces, key=lambda one: -one.area):
        for n in reversed(range(len(out))):
            if is_part(piece, out[n], own) or carries(piece, out[n], up):
                piece = joined([out.pop(n), piece])
        out.append(piece)
    return sorted(out, key=lambda one: -one.area)


def is_part(piece: Piece, thing: Piece, own: Visit) -> bool:
    """Whether a piece may be part of a near larger one, without observed free space between them."""
    return gap_between(thing, piece) < REACH * thing.length and is_hidden_between(thing, piece, own)


def carries(piece: Piece, thing: Piece, up: NDArray[np.float64]) -> bool:
    """Whether a piece is a leg of a thing: a slim column within its outline along ``up`` (3,)."""
    across = np.linalg.svd(up[None])[2][1:].T
    leg, outline = piece.points @ across, thing.points[:: max(1, len(thing.points) // 2000)] @ across
    height = np.ptp(np.percentile(piece.points @ up, [2, 98]))
    if np.ptp(np.percentile(leg, [2, 98], axis=0), axis=0).max() > SLIM * height:
        return False
    middle = outline.mean(axis=0)
    inside = Delaunay(OUTLINE * (outline - middle)).find_simplex(leg - middle) >= 0
    return bool(inside.mean() > 0.5)


def is_hidden_between(a: Piece, b: Piece, own: Visit) -> bool:
    """Whether half of the shortest lines between two pieces show no free space."""
    some, steps = b.points[:: max(1, len(b.points) // 200)], np.linspace(0, 1, 20)[:, None]
    gap, near = KDTree(a.points).query(some)
    ways = np.argsort(gap)[: max(5, len(some) // 5)]
    start, end = some[ways][:, None], a.points[np.asarray(near)[ways]][:, None]
    samples, clear = own.sample((start + (end - start) * steps).reshape(-1, 3)), 2 * own.volume.voxel_size
    return bool(np.median(samples.is_free(clear).reshape(len(ways), -1).mean(axis=1) * gap[ways]) < clear)


def is_certain(piece: Piece, found: Evidence, min_size: float) -> bool:
    """Whether a piece is large, wider than depth edges, and well seen."""
    if np.median(found.weight[piece.vertices]) < CERTAIN * found.min_weight:
        return False
    if np.median(found.gap[piece.vertices] / found.tolerance[piece.vertices]) < CLEAR:
        return False
    if np.median(facing(found, piece)[1]) < LEAST_FACING:
        return False
    if piece.area < LEAST_COVER * np.prod(np.sort(piece.box[1] - piece.box[0])[1:]):
        return False
    return is_wide(piece.points, 0.7 * min_size, 3 * float(np.median(found.blur[piece.vertices])))


def facing(found: Evidence, piece: Piece) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Some vertices (n,) of a piece, and cosines (n,) of the best viewing angle; negative from behind."""
    vertices = piece.vertices[:: max(1, len(piece.vertices) // 500)]
    rays = found.cameras[:, None] - found.points[vertices]
    cosines = (rays * found.mesh.normals[vertices]).sum(axis=2) / np.linalg.norm(rays, axis=2)
    return vertices, cosines.max(axis=0)


def is_wide(points: NDArray[np.float64], length: float, width: float) -> bool:
    """Whether points (n, 3) exceed a length and a width (m) along their principal axes."""
    points = points[:: max(1, len(points) // 2000)]
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    low, high = np.percentile(points @ axes.T, [2, 98], axis=0)
    extents = np.sort(high - low)
    return bool(extents[2] > length and extents[1] > width)


def opened(found: Evidence, flagged: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Remove flagged vertices (V,) on the blurred edge of confirmed surface, except near the remaining core."""
    numbers, points = np.flatnonzero(flagged), found.points
    against = (found.state == CONFIRMED) & ~flagged
    if len(numbers):
        reach = found.blur[numbers].max()
        low, high = points[numbers].min(axis=0) - reach, points[numbers].max(axis=0) + reach
        against &= np.all((points > low) & (points < high), axis=1)
    against = points[against]
    if len(numbers) == 0 or len(against) == 0:
        return flagged.copy()
    blur = found.blur[numbers]
    core = surface_tree(against).query(points[numbers], workers=-1)[0] > blur
    out = np.zeros(len(flagged), bool)
    if core.any():
        out[numbers[KDTree(points[numbers[core]]).query(points[numbers])[0] <= blur]] = True
    return out


def connected(found: Evidence, chosen: NDArray[np.bool_], gap: float) -> list[Piece]:
    """Groups of chosen vertices (V,) with gaps up to ``gap`` (m), largest first."""
    numbers, points = np.flatnonzero(chosen), found.points[chosen]
    if len(numbers) == 0:
        return []
    places, cell = np.unique(np.floor(points / (gap / 2)).astype(np.int64), axis=0, return_inverse=True)
    group = components(KDTree(places).query_pairs(2.0, p=np.inf, output_type="ndarray"), len(places))[cell.reshape(-1)]
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    pieces = [Piece(numbers[rows], points[rows], float(found.areas[numbers[rows]].sum())) for rows in members]
    return sorted(pieces, key=lambda piece: -piece.area)


def gap_between(a: Piece, b: Piece) -> float:
    """Distance of two pieces, metres; of their boxes beyond 1 m."""
    apart = float(np.linalg.norm(np.maximum(np.maximum(a.box[0] - b.box[1], b.box[0] - a.box[1]), 0)))
    return apart if apart > 1 else float(KDTree(a.points).query(b.points)[0].min())


def joined(pieces: list[Piece]) -> Piece:
    """Join pieces of one mesh."""
    return Piece(
        np.concatenate([piece.vertices for piece in pieces]), np.concatenate([piece.points for piece in pieces]),
        sum(piece.area for piece in pieces),
    )  # fmt: skip
