"""Agreement of two maps: surface of one that the other confirms, denies, or never saw."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.fleet.map_samples import EMPTY, IN_BAND, OBSERVED, SurfacePoints, sample_map, transformed

CELL = 0.25
"""Edge of the cells in which mean colours are compared, metres."""
MIN_CELL_POINTS = 8
"""Fewest points of a cell."""
MIN_COLORED = 200
"""Fewest points with colours in both maps."""
MAX_COLOR_DIFFERENCE = 20.0
"""Largest difference of agreeing mean colours, per channel, after gain, grey levels."""

MIN_AREA, MIN_OVERLAP = 1.0, 0.1
"""Smallest common surface: square metres, and share of the smaller map's."""
CLEAR_DISTANCE = 0.1
"""Distance of denied from all other surface, metres, above drift, noise and bending."""
MAX_DENIED = 0.01
"""Largest share of compared surface in the other's free space. Measured: 0 to 0.006 for one place, 0.0185 to 0.12 for
moved furniture, 0.006 to 0.024 for similar floors."""
MAX_CHANGED = 0.5
"""Largest denied share of two visits with changes."""
MIN_CORRELATION, MIN_COLOR_SHARE = 0.7, 0.9
"""Correlation of intensities, and share of cells with agreeing colours: 0.995 and 1.0 for one rendered room; 0.86 and
0.80 with other small textures."""
MAX_OTHER_COLOR, MAX_OTHER_SHARE = 0.1, 0.003
"""Surface with other colours, square metres, or share of the common surface, among many runs: one floor has up to 0.05
m2, similar floors 0.35."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Comparison of the surfaces of two maps.

    Attributes:
        area: Common surface, square metres (mean of both directions).
        overlap: Its share of the smaller map's surface.
        denied: Share of the compared surface, near a camera, in the other's free space; the larger direction.
        color_correlation: Of the common surface's intensities.
        color_share: Share of its cells with agreeing mean colours.
        other_color: Surface in the other cells, square metres.
    """

    area: float
    overlap: float
    denied: float
    color_correlation: float
    color_share: float
    other_color: float

    @property
    def enough(self) -> bool:
        """Whether the common surface suffices."""
        return self.area >= MIN_AREA and self.overlap >= MIN_OVERLAP

    def rejection_reason(self, many: bool = False, changed: bool = False) -> str:
        """Sentence on the first failed check, empty if the maps can be merged.

        ``many``: one of many runs. ``changed``: two visits with changes of things, paint or light.
        """
        if not self.enough:
            return f"they share only {self.area:.1f} m2 of surface, {self.overlap:.0%} of the smaller map"
        if self.denied > (MAX_CHANGED if changed else MAX_DENIED):
            return f"{self.denied:.1%} of the surface of one lies in free space of the other: the geometry disagrees"
        return self.color_reason(many, 0.0 if changed else MIN_COLOR_SHARE)

    def color_reason(self, many: bool, min_share: float = MIN_COLOR_SHARE) -> str:
        """Sentence on disagreeing colours, empty if at least ``min_share`` of the cells agree."""
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
    """Compare two maps by surface points at ``T_a_b`` (4, 4), world of b to a."""
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
