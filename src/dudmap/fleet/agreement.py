"""Agreement of two maps at a relative pose: the surface of one that the other confirms, denies, or never saw."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.fleet.map_samples import EMPTY, IN_BAND, OBSERVED, SurfacePoints, sample_map, transformed

CELL = 0.25
"""Edge of the cells in which mean surface colours are compared, metres."""
MIN_CELL_POINTS = 8
"""Fewest points of a cell with a mean colour."""
MIN_COLORED = 200
"""Fewest points with colours in both maps for a comparison of colours."""
MAX_COLOR_DIFFERENCE = 20.0
"""Largest difference of a cell's mean colours that agree, per channel, after its gain, grey levels."""

MIN_AREA, MIN_OVERLAP = 1.0, 0.1
"""Smallest common surface: square metres, and share of the surface of the smaller map."""
CLEAR_DISTANCE = 0.1
"""Smallest distance of denied surface from all surface of the other map, metres: drift, noise and bending shift
surface by centimetres."""
MAX_DENIED = 0.01
"""Largest share of the compared surface in free space of the other map. Measured: 0 to 0.006 for one place, 0.0185
to 0.12 for moved furniture, 0.006 to 0.024 for similar floors."""
MAX_CHANGED = 0.5
"""The same share for two visits between which things may have moved."""
MIN_CORRELATION, MIN_COLOR_SHARE = 0.7, 0.9
"""Smallest correlation of intensities, and smallest share of cells with agreeing colours. Measured: 0.995 and 1.0
for one rendered room; 0.86 and 0.80 with other textures on small things."""
MAX_OTHER_COLOR, MAX_OTHER_SHARE = 0.1, 0.003
"""Largest surface with disagreeing colours, square metres, or this share of the common surface, for pairs among many
runs: similar places differ by single things. Similar floors have at least 0.35 m2, maps of one floor up to 0.05 m2."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Comparison of the surfaces of two maps.

    Attributes:
        area: Surface that both maps have at the same place, square metres (mean of both directions).
        overlap: That surface as a share of the smaller map's surface.
        denied: Share of the compared surface, near enough to a camera, in known free space of the other map; the larger
            of both directions.
        color_correlation: Correlation of the intensities of the common surface.
        color_share: Share of the cells of the common surface whose mean colours agree.
        other_color: Common surface in the other cells, square metres.
    """

    area: float
    overlap: float
    denied: float
    color_correlation: float
    color_share: float
    other_color: float

    @property
    def enough(self) -> bool:
        """Whether the common surface is large enough for a comparison."""
        return self.area >= MIN_AREA and self.overlap >= MIN_OVERLAP

    def rejection_reason(self, many: bool = False, changed: bool = False) -> str:
        """Sentence on the first check that fails, empty if the maps can be merged.

        ``many``: one of many runs. ``changed``: two visits, whose things may have moved, been painted or lit
        differently.
        """
        if not self.enough:
            return f"they share only {self.area:.1f} m2 of surface, {self.overlap:.0%} of the smaller map"
        if self.denied > (MAX_CHANGED if changed else MAX_DENIED):
            return f"{self.denied:.1%} of the surface of one lies in free space of the other: the geometry disagrees"
        return self.color_reason(many, 0.0 if changed else MIN_COLOR_SHARE)

    def color_reason(self, many: bool, min_share: float = MIN_COLOR_SHARE) -> str:
        """Sentence on how the colours disagree, empty if they agree in at least ``min_share`` of the cells."""
        if self.color_correlation < MIN_CORRELATION or self.color_share < min_share:
            return (
                f"the colours disagree: their correlation is {self.color_correlation:.2f}, and "
                f"{self.color_share:.1%} of the common surface has the same colour"
            )
        if many and self.other_color > max(MAX_OTHER_COLOR, MAX_OTHER_SHARE * self.area):
            return f"the colours disagree: {self.other_color:.2f} of {self.area:.1f} m2 have another colour"
        return ""


def agreement(
    a: TsdfVolume, b: TsdfVolume, of_a: SurfacePoints, of_b: SurfacePoints, T_a_b: NDArray[np.float64]
) -> Agreement:
    """Compare two maps by surface points at a relative pose ``T_a_b`` (4, 4), world of b to world of a."""
    common_b, denied_b, color_a = _compared(a, of_a, of_b, T_a_b)
    common_a, denied_a, color_b = _compared(b, of_b, of_a, se3.inverse(T_a_b))
    area = (common_b.sum() * of_b.area_each + common_a.sum() * of_a.area_each) / 2
    smaller = min(len(of_a) * of_a.area_each, len(of_b) * of_b.area_each)
    denied = max(_share(denied_a & of_a.near, common_a & of_a.near), _share(denied_b & of_b.near, common_b & of_b.near))
    points = np.concatenate([transformed(T_a_b, of_b.points[common_b]), of_a.points[common_a]])
    colors_a = np.concatenate([color_a, of_a.color[common_a]]).astype(np.float64)
    colors_b = np.concatenate([of_b.color[common_b], color_b]).astype(np.float64)
    areas = np.repeat([of_b.area_each / 2, of_a.area_each / 2], [common_b.sum(), common_a.sum()])
    colors = _color_agreement(points, colors_a, colors_b, areas)
    return Agreement(float(area), float(area / max(smaller, 1e-9)), float(denied), *colors)


def _share(denied: NDArray[np.bool_], common: NDArray[np.bool_]) -> float:
    return denied.sum() / max(denied.sum() + common.sum(), 1)


def _compared(
    volume: TsdfVolume, own: SurfacePoints, surface: SurfacePoints, T: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float32]]:
    """Points (n,) of a surface that a map confirms, those it denies, and its colours (m, 3). Points behind the
    surface are neither: a map need not hold both sides of a plate."""
    points = transformed(T, surface.points)
    samples = sample_map(volume, points)
    known = samples.state == OBSERVED
    common = known & (np.abs(samples.sdf) < volume.truncation / 2)
    denied = (samples.state == EMPTY) | (known & (samples.sdf >= IN_BAND * volume.truncation))
    denied[denied] = KDTree(own.points).query(points[denied])[0] > CLEAR_DISTANCE
    return common, denied, samples.color[common]


def _color_agreement(
    points: NDArray[np.float64],
    colors_a: NDArray[np.float64],
    colors_b: NDArray[np.float64],
    areas: NDArray[np.float64],
) -> tuple[float, float, float]:
    """Correlation of intensities of points (n, 3), share of cells with agreeing colours, area of the others."""
    known = (colors_a.max(axis=1) > 0) & (colors_b.max(axis=1) > 0)
    if np.count_nonzero(known) < MIN_COLORED:
        return 0.0, 0.0, 0.0
    points, colors_a, colors_b, areas = points[known], colors_a[known], colors_b[known], areas[known]
    grey_a, grey_b = colors_a.mean(axis=1), colors_b.mean(axis=1)
    plain = min(grey_a.std(), grey_b.std()) < 1e-6
    correlation = 0.0 if plain else float(np.corrcoef(grey_a, grey_b)[0, 1])
    gain = np.median(colors_a, axis=0) / np.maximum(np.median(colors_b, axis=0), 1)
    cells = np.floor(points / CELL).astype(np.int64)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    enough = counts >= MIN_CELL_POINTS
    if not enough.any():
        return correlation, 0.0, 0.0
    sums = np.stack([np.bincount(cell, channel) for channel in (colors_a - gain * colors_b).T], axis=1)
    agreeing = np.abs(sums[enough] / counts[enough, None]).max(axis=1) < MAX_COLOR_DIFFERENCE
    other = np.bincount(cell, areas)[enough][~agreeing].sum()
    return correlation, float(np.mean(agreeing)), float(other)
