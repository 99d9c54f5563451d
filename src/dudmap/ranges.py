"""Ranges of the camera: every length of the configuration scaled to the scene.

If a scene, the noise of its camera and every length are scaled by s, residuals in standard deviations, labels and
decisions stay the same. The noise s sigma(z / s) is s sigma_base + (sigma_scale / s) z^2.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

RANGES = {"near": 0.2, "room": 1.0, "far": 2.5}
"""Size of the scene, rooms. near: voxels of 2 mm, depth 0.04 to 1.2 m; far: 2.5 cm, 0.5 to 15 m."""
SMALLEST, LARGEST = 0.2, 5.0
"""Bounds of the size: voxels of 2 mm and of 5 cm."""
MEDIAN, FARTHEST = 5.0, 6.0
"""Largest median and 98 % quantile of the depth, metres, of a room: 500 and 600 voxels."""
NEAREST_MEDIAN = 0.3
"""Smallest median depth of a room, metres; below it many measurements are nearer than 0.2 m."""
FEW = 0.2
"""Smallest share of measured pixels for the choice of a range."""

POWERS = {
    "sensor": {"reference_depth": 1, "sigma_base": 1, "sigma_scale": -1},
    "preprocess": {"depth_min": 1, "depth_max": 1},
    "similarity": {"max_translation": 1},
    "volume": {"voxel_size": 1},
    "tracker": {"huber": 1, "color_weight": 2, "max_speed": 1},
    "relocalization": {"keyframe_distance": 1},
    "loops": {"keep_distance": 1},
    "movers": {"min_area": 2, "mesh_voxel_size": 1},
}
"""Exponent of the scene's size in a parameter's scale; other parameters contain no length."""


def scaled(tree: Mapping[str, Any], size: float) -> dict[str, Any]:
    """The values of a whole configuration for a scene of ``size`` rooms."""
    if size == 1:
        return dict(tree)
    out = {key: dict(values) if isinstance(values, Mapping) else values for key, values in tree.items()}
    for section, powers in POWERS.items():
        for key, power in powers.items():
            out[section][key] = _rounded(out[section][key] * size**power)
    return out


def size_of(depths: "Iterable[NDArray[np.float32]]") -> float:
    """Size of the scene in some depth images (H, W), metres, relative to a room (1).

    The voxel size of other scenes is the larger of 1/500 of the median depth and 1/600 of the 98 % quantile, within 2
    mm to 5 cm.
    """
    import numpy as np

    images = list(depths)
    readings = np.concatenate([image[image > 0] for image in images]) if images else np.zeros(0)
    if len(readings) <= FEW * sum(image.size for image in images):
        return 1.0
    median, farthest = np.percentile(readings, (50, 98)).tolist()
    if NEAREST_MEDIAN <= median <= MEDIAN:
        return 1.0
    wanted = median / MEDIAN if median < MEDIAN else max(median / MEDIAN, farthest / FARTHEST)
    return float(f"{min(max(wanted, SMALLEST), LARGEST):.2g}")


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
