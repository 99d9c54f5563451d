"""Surface in place with other colours: a poster, a screen, a painted wall.

Light changes smoothly: a gain is fitted to the cells around each cell. A difference above the spread of all cells marks
other colours.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.map import morton
from dudmap.fleet.change_evidence import CONFIRMED, DEVIATIONS, Evidence
from dudmap.fleet.change_objects import Piece, connected, facing, is_wide

CELL, CELL_VOXELS = 0.05, 4
"""Smallest edge of colour cells, metres and voxels."""
AROUND = 0.6
"""Radius of constant light, metres."""
LEAST_POINTS, LEAST_AROUND = 6, 12
"""Fewest vertices of a cell, and cells that determine the light."""
LEAST_DIFFERENCE = 20.0
"""Smallest colour difference of changed cells, grey levels; a merge's limit."""
CHROMA, CORRELATION, TEXTURE = 0.05, 0.4, 8.0
"""Changes not caused by light: difference of the shares of red, green and blue, or lower correlation of textures above
a standard deviation (grey levels)."""
SOLID = 0.7
"""Smallest recoloured share of a change's extent, unlike highlights."""


def recolored_pieces(
    found: Evidence, voxel_size: float, min_size: float, solid: float = SOLID
) -> list[tuple[Piece, float]]:
    """Pieces of the own mesh with other colours, and the recoloured share of their surface."""
    known = np.flatnonzero((found.state == CONFIRMED) & (found.other_color.max(axis=1) > 0))
    known = known[found.mesh.colors[known].max(axis=1) > 0]
    if len(known) < LEAST_AROUND * LEAST_POINTS:
        return []
    points, edge = found.points[known], max(CELL, CELL_VOXELS * voxel_size)
    _, cell, counts = np.unique(
        morton.encode(np.floor(points / edge).astype(np.int64)), return_inverse=True, return_counts=True
    )

    def mean(values: NDArray) -> NDArray[np.float64]:
        return np.stack([np.bincount(cell, column) for column in values.T], axis=1) / counts[:, None]

    own, other, centres = mean(found.mesh.colors[known].astype(float)), mean(found.other_color[known]), mean(points)
    use = counts >= LEAST_POINTS
    different = np.zeros(len(use), bool)
    different[use] = _different(centres[use], own[use], other[use])
    chosen = np.zeros(len(found.state), bool)
    chosen[known[different[cell]]] = True
    out, light = [], np.median(own, axis=0) / np.maximum(np.median(other, axis=0), 1)
    for piece in connected(found, chosen, 2 * edge):
        low, high = piece.box
        inside = known[np.all((points >= low) & (points <= high), axis=1)]
        share = len(piece.vertices) / max(len(inside), 1)
        is_large = piece.area > min_size**2 and is_wide(piece.points, min_size, min_size)
        rows = found.mesh.colors[piece.vertices].astype(float), found.other_color[piece.vertices].astype(float)
        vertices, cosines = facing(found, piece)
        is_sharp = (
            np.median(found.blur[vertices] / np.maximum(cosines, 1e-3)) < edge
        )  # pixels on it are smaller than a cell
        if share > solid and is_large and is_sharp and _is_paint(*rows, light):
            out.append((piece, float(share)))
    return out


def _different(centres: NDArray[np.float64], own: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
    logs = np.log((own + 8) / (other + 8))
    near = KDTree(centres).query(centres, k=64, distance_upper_bound=AROUND)[1]
    padded = np.concatenate([logs, np.full((1, 3), np.nan)])[near]
    enough = (near < len(centres)).sum(axis=1) >= LEAST_AROUND
    gain = np.exp(np.nanmedian(padded, axis=1))
    difference = np.abs(own - gain * other).max(axis=1)
    usual = 1.4826 * float(np.median(difference))
    return enough & (difference > max(LEAST_DIFFERENCE, DEVIATIONS * usual))


def _is_paint(own: NDArray[np.float64], other: NDArray[np.float64], light: NDArray[np.float64]) -> bool:
    shares = [(colors + 8) / (colors + 8).sum(axis=1, keepdims=True) for colors in (own, other * light)]
    if np.abs(np.median(shares[0], axis=0) - np.median(shares[1], axis=0)).max() > CHROMA:
        return True
    grey = own.mean(axis=1), other.mean(axis=1)
    return bool(min(grey[0].std(), grey[1].std()) > TEXTURE and np.corrcoef(*grey)[0, 1] < CORRELATION)
