"""Comparison of a surface with the true one: accuracy, completeness, ghosts.

Uniform points of one surface are measured to the nearest triangle of the other.

``MapError``: NaN, or no faces (unless point clouds are accepted); ``ConfigError``: a distance or number that is not
positive.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.mesh import Mesh
from dudmap.errors import ConfigError
from dudmap.evaluation.surface import Surface
from dudmap.evaluation.trajectory import Statistics

Distances = NDArray[np.float32]

THRESHOLDS = (0.01, 0.02, 0.05)
GHOST_DISTANCE = 0.05
"""Distance of ghosts from the true surface, metres: between noise and an arm."""
SAMPLES = 300_000
"""Points sampled on each surface: a share of 1 % errs by 0.02 %."""
HISTOGRAM_LARGEST, HISTOGRAM_BINS = 0.2, 100
"""Bins of 2 mm; the last also counts everything beyond."""


class ThresholdScore(NamedTuple):
    """Precision and recall at a distance (Knapitsch et al. 2017, Tanks and Temples, eq. 3-5).

    Attributes:
        distance: Metres.
    """

    distance: float
    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, eq=False)
class SurfaceResult:
    """Comparison of an estimated surface with the true one. Areas of a point cloud are None.

    Attributes:
        area_m2, reference_area_m2, ghost_area_m2: Of the estimate, the reference for completeness, the ghosts.
        ghost_distance: Metres.
        histogram_edges: (B + 1,) metres.
        accuracy_histogram, completeness_histogram: (B,) shares per bin.
    """

    accuracy: Statistics
    completeness: Statistics
    scores: tuple[ThresholdScore, ...]
    area_m2: float | None
    reference_area_m2: float | None
    ghost_distance: float
    ghost_area_m2: float | None
    ghost_share: float
    missing_share: float
    histogram_edges: NDArray[np.float64]
    accuracy_histogram: NDArray[np.float64]
    completeness_histogram: NDArray[np.float64]
    num_samples: int

    def figures(self) -> dict[str, float | int | None]:
        """All metrics by name and unit, for tables and JSON."""
        out: dict[str, float | int | None] = {}
        for name, statistics in (("accuracy", self.accuracy), ("completeness", self.completeness)):
            for key in ("mean", "median", "rmse", "p95", "max"):
                out[f"{name}_{key}_m"] = round(getattr(statistics, key), 6)
        for score in self.scores:
            for key in ("precision", "recall", "f_score"):
                out[f"{key}_{1000 * score.distance:g}mm"] = round(getattr(score, key), 5)
        out["ghost_distance_m"] = round(self.ghost_distance, 5)
        for key in ("ghost_area_m2", "ghost_share", "missing_share", "area_m2", "reference_area_m2"):
            value = getattr(self, key)
            out[key] = None if value is None else round(value, 5)
        return out | {"num_samples": self.num_samples}


def compare_surfaces(
    estimate: Mesh,
    reference: Mesh | Surface,
    *,
    observed: Mesh | Surface | None = None,
    thresholds: Iterable[float] = THRESHOLDS,
    ghost_distance: float = GHOST_DISTANCE,
    samples: int = SAMPLES,
    points: bool = False,
) -> SurfaceResult:
    """Accuracy, completeness, F-scores and ghosts of an estimated surface.

    Args:
        estimate: In the reference's frame.
        reference: True static surface.
        observed: Part that the camera saw, for completeness; None for all.
        thresholds: Metres, for precision, recall and F-score.
        ghost_distance: Metres.
        samples: Points on each surface.
        points: Accept point clouds as samples.
    """
    thresholds = tuple(thresholds)
    _check_positive("samples", samples)
    _check_positive("the ghost distance", ghost_distance)
    for threshold in thresholds:
        _check_positive("a threshold", threshold)
    truth = _surface(reference, "the reference", points)
    found = Surface(estimate, "the estimate", points=points)
    part = truth if observed is None else _surface(observed, "the observed part of the reference", points)
    to_truth = truth.distances(found.samples(samples, 0))
    to_found = found.distances(part.samples(samples, 1))
    ghost_share = float(np.mean(to_truth > ghost_distance))
    edges = np.linspace(0.0, HISTOGRAM_LARGEST, HISTOGRAM_BINS + 1)
    return SurfaceResult(
        accuracy=Statistics.of(to_truth),
        completeness=Statistics.of(to_found),
        scores=tuple(_score(to_truth, to_found, threshold) for threshold in thresholds),
        area_m2=found.area,
        reference_area_m2=part.area,
        ghost_distance=ghost_distance,
        ghost_area_m2=None if found.area is None else ghost_share * found.area,
        ghost_share=ghost_share,
        missing_share=float(np.mean(to_found > ghost_distance)),
        histogram_edges=edges,
        accuracy_histogram=_histogram(to_truth, edges),
        completeness_histogram=_histogram(to_found, edges),
        num_samples=samples,
    )


def _check_positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ConfigError(f"{name} is {value}; expected a positive number")


def _surface(mesh: Mesh | Surface, name: str, points: bool) -> Surface:
    return mesh if isinstance(mesh, Surface) else Surface(mesh, name, points=points)


def error_mesh(estimate: Mesh, reference: Mesh, *, largest: float = GHOST_DISTANCE, points: bool = False) -> Mesh:
    """The estimate, coloured by its distance to the reference: blue at 0 to red at ``largest`` metres."""
    _check_positive("the distance at the end of the colour scale", largest)
    distances = Surface(reference, "the reference", points=points).distances(estimate.vertices)
    return Mesh(estimate.vertices, estimate.faces, distance_colors(distances, largest), estimate.normals)


def distance_colors(distances: Distances, largest: float) -> NDArray[np.uint8]:
    """Colours (N, 3) from blue at 0 to red at ``largest``."""
    anchors = np.array([[40, 70, 200], [40, 170, 190], [90, 190, 70], [240, 210, 50], [210, 40, 30]], dtype=np.float64)
    at = np.clip(np.nan_to_num(distances.astype(np.float64), nan=largest) / largest, 0, 1) * (len(anchors) - 1)
    steps = np.arange(len(anchors))
    return np.stack([np.interp(at, steps, anchors[:, k]) for k in range(3)], axis=1).round().astype(np.uint8)


def _score(to_truth: Distances, to_found: Distances, distance: float) -> ThresholdScore:
    precision, recall = float(np.mean(to_truth < distance)), float(np.mean(to_found < distance))
    f_score = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return ThresholdScore(distance, precision, recall, f_score)


def _histogram(distances: Distances, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    counted, _ = np.histogram(np.minimum(distances, np.nextafter(edges[-1], 0)), bins=edges)
    return counted / max(len(distances), 1)
