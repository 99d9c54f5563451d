"""From denied surface to things: connected pieces, which of them moved, which came, went, or got other colours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dudmap.core.geometry.mesh import Mesh
from dudmap.fleet.change_evidence import CONFIRMED, DENIED, Evidence, surface_tree

LINK = 4.0
"""Gap between pieces of one thing, voxels."""
BRIDGE = 0.15
"""The same through surface that the other map did not see, metres: free space is known in blocks, whose borders remain
unknown."""
LEAST_FACE = 0.3
"""Area of a change in squares of the smallest size that is looked for; a cube shows one of its faces, partly."""
LEAST_WIDTH = 0.5
"""Width of a change, the middle one of its three extents, in smallest sizes: edges are long and thin."""
CERTAIN = 2
"""A change is certain if half of its surface has this multiple of the weight that a mesh needs, the other half less."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Connected surface of one map that the other denies.

    Attributes:
        vertices: (n,) int, numbers of its vertices in the mesh of the evidence.
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


def denied_pieces(found: Evidence, voxel_size: float, min_size: float) -> list[Piece]:
    """Pieces of surface that the other map denies beyond the noise, the largest first."""
    pieces = connected(found.mesh, opened(found, found.state == DENIED), LINK * voxel_size)
    unseen = found.mesh.faces[np.all(found.state[found.mesh.faces] != CONFIRMED, axis=1)]
    pieces = bridged(pieces, unseen, len(found.state))
    return [piece for piece in pieces if is_certain(piece, found, min_size)]


def is_certain(piece: Piece, found: Evidence, min_size: float) -> bool:
    """Whether a piece is large enough, wider than the depth edges there, and was seen often enough."""
    if piece.area < LEAST_FACE * min_size**2 or np.median(found.weight[piece.vertices]) < CERTAIN * found.min_weight:
        return False
    blur = float(np.median(found.blur[piece.vertices]))
    return is_wide(piece.points, 0.7 * min_size, max(LEAST_WIDTH * min_size, 3 * blur))


def is_wide(points: NDArray[np.float64], length: float, width: float) -> bool:
    """Whether points (n, 3) extend so far (m) along the first two of their principal axes."""
    points = points[:: max(1, len(points) // 2000)]
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    low, high = np.percentile(points @ axes.T, [2, 98], axis=0)
    extents = np.sort(high - low)
    return bool(extents[2] > length and extents[1] > width)


def opened(found: Evidence, flagged: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Flagged vertices (V,) that are not, nor hang on, the blurred edge of surface that the other map confirms."""
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


def connected(mesh: Mesh, chosen: NDArray[np.bool_], gap: float) -> list[Piece]:
    """Groups of chosen vertices (V,) of a mesh that are at most about a gap (m) from each other, the largest first."""
    numbers = np.flatnonzero(chosen)
    if len(numbers) == 0:
        return []
    places, cell = np.unique(np.floor(mesh.vertices[numbers] / (gap / 2)).astype(np.int64), axis=0, return_inverse=True)
    group = _components(KDTree(places).query_pairs(2.0, p=np.inf, output_type="ndarray"), len(places))
    return _grouped(numbers, group[cell.reshape(-1)], mesh)


def bridged(pieces: list[Piece], unseen: NDArray[np.int32], count: int) -> list[Piece]:
    """Pieces of which those are one that hang together by triangles (n, 3) of a mesh with ``count`` vertices."""
    surface = _components(np.concatenate([unseen[:, :2], unseen[:, 1:]]), count)
    parts = [np.unique(surface[piece.vertices]) for piece in pieces]
    pairs = [
        (a, b) for a in range(len(pieces)) for b in range(a)
        if len(np.intersect1d(parts[a], parts[b], assume_unique=True))
        and gap_between(pieces[a], pieces[b]) < BRIDGE
    ]  # fmt: skip
    group = _components(np.array(pairs, np.int64).reshape(-1, 2), len(pieces))
    return [joined([pieces[n] for n in np.flatnonzero(group == g)]) for g in np.unique(group)]


def gap_between(a: Piece, b: Piece) -> float:
    """Distance of the nearest points of two pieces, metres; that of their boxes if it is large."""
    apart = float(np.linalg.norm(np.maximum(np.maximum(a.box[0] - b.box[1], b.box[0] - a.box[1]), 0)))
    return apart if apart > 1 else float(KDTree(a.points).query(b.points)[0].min())


def joined(pieces: list[Piece]) -> Piece:
    """Pieces of one mesh as one."""
    return Piece(
        np.concatenate([piece.vertices for piece in pieces]), np.concatenate([piece.points for piece in pieces]),
        sum(piece.area for piece in pieces),
    )  # fmt: skip


def _grouped(numbers: NDArray[np.intp], group: NDArray[np.intp], mesh: Mesh) -> list[Piece]:
    """Pieces of vertices (n,) by the number (n,) of their group, the largest first."""
    areas, out = vertex_areas(mesh)[numbers], []
    for members in np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1]):
        points = mesh.vertices[numbers[members]].astype(np.float64)
        out.append(Piece(numbers[members], points, float(areas[members].sum())))
    return sorted(out, key=lambda piece: -piece.area)


def _components(pairs: NDArray[np.integer], count: int) -> NDArray[np.intp]:
    """Number (count,) of the connected component of each node of a graph with edges (n, 2)."""
    graph = csr_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def vertex_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Surface (V,) that each vertex stands for, square metres."""
    a, b, c = (mesh.vertices[mesh.faces[:, n]] for n in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1).astype(np.float64) / 6
    return np.bincount(mesh.faces.reshape(-1), np.repeat(areas, 3), len(mesh.vertices)).astype(np.float64)
