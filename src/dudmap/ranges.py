"""Ranges of the camera: every length of the configuration scaled to the size of the scene.

A scene s times as large as a room, seen by a camera whose noise is that of a room's camera in proportion, gives the
same residuals, labels and decisions if every length is multiplied by s. So the noise is s sigma(z / s), which is
s sigma_base + (sigma_scale / s) z^2.
"""

from collections.abc import Mapping
from typing import Any

RANGES = {"near": 0.2, "room": 1.0, "far": 2.5}
"""Size of the scene, in rooms. near: voxels of 2 mm, readings from 0.04 to 1.2 m; far: 2.5 cm, 0.5 to 15 m."""
SMALLEST, LARGEST = 0.2, 5.0
"""Bounds of the size: voxels of 2 mm and of 5 cm."""
VOXELS = 500
"""Voxels from the camera to the median reading: the default of 1 cm at 5 m."""
MEDIANS = 0.4, 5.0
"""Medians of the readings, metres, that are a room's: nearer, more than half of them may lie before its range; farther,
voxels larger than those of a room suffice."""

POWERS = {
    "sensor": {"reference_depth": 1, "sigma_base": 1, "sigma_scale": -1},
    "preprocess": {"depth_min": 1, "depth_max": 1, "filter_alpha": -1},
    "similarity": {"max_translation": 1},
    "volume": {"voxel_size": 1},
    "tracker": {"huber": 1, "tukey": 1, "color_weight": 2, "max_speed": 1},
    "dynamics": {"threshold": 1, "noise_threshold": 1},
    "relocalization": {"keyframe_distance": 1, "max_distance": 1},
    "loops": {"min_distance": 1, "keep_distance": 1},
    "movers": {"min_area": 2, "merge_distance": 1, "max_jump": 1, "mesh_voxel_size": 1},
}
"""Power of the size of the scene by which a parameter grows. All others have no length in them."""
SHRINKING = {"tracker": ("stop", "stop_coarse")}
"""Parameters of metres and radians at once, which shrink with the scene and do not grow."""


def scaled(tree: Mapping[str, Any], size: float) -> dict[str, Any]:
    """The values of a whole configuration for a scene of a ``size``, in rooms; a size of 1 changes nothing."""
    if size == 1:
        return dict(tree)
    out = {key: dict(values) if isinstance(values, Mapping) else values for key, values in tree.items()}
    for section, powers in POWERS.items():
        for key, power in powers.items():
            out[section][key] = _rounded(out[section][key] * size**power)
    for section, keys in SHRINKING.items():
        for key in keys:
            out[section][key] = _rounded(out[section][key] * min(size, 1.0))
    return out


def size_of(median: float) -> float:
    """Size of a scene, in rooms, whose readings have this median, metres."""
    if MEDIANS[0] <= median <= MEDIANS[1]:
        return 1.0
    default = 0.01  # the voxel size of a room
    return _rounded(min(max(median / VOXELS / default, SMALLEST), LARGEST))


def _rounded(value: float) -> float:
    """The value with the digits that one writes."""
    return float(f"{value:.3g}")
