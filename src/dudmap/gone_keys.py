"""Configuration keys of earlier versions."""

from collections.abc import Mapping
from typing import Any

from dudmap.errors import ConfigError

THESIS = "--system thesis runs the system of the thesis, with the parameters of the section thesis"
ALWAYS = "the part is always on"
FIXED = "the value is a constant of "

GONE: dict[str, tuple[Any, str]] = {
    "preset": ("default", THESIS),
    "tracker.robust": ("huber", f'{THESIS}, e.g. thesis.estimator = "tukey"'),
    "tracker.tukey": (0.05, f'{THESIS}, e.g. thesis.estimator = "tukey"'),
    "tracker.second_pass": (True, "dynamics.enabled = false registers a frame once"),
    "tracker.constant_velocity": (True, ALWAYS),
    "tracker.noise_weighting": (True, "sensor.sigma_scale = 0 gives all depths one noise"),
    "similarity.measure": ("information", f"{THESIS}, e.g. thesis.similarity"),
    "similarity.ratio": (0.7, f"{THESIS}, e.g. thesis.lowe_ratio"),
    "similarity.image_width": (320, f"{THESIS}, e.g. thesis.similarity"),
    "similarity.max_features": (500, f"{THESIS}, e.g. thesis.similarity"),
    "dynamics.method": ("em", f"dynamics.enabled = false labels nothing, and {THESIS}"),
    "dynamics.threshold": (0.07, f"{THESIS}, e.g. thesis.theta"),
    "dynamics.free_space": (True, ALWAYS),
    "dynamics.regions": (True, ALWAYS),
    "dynamics.pieces": (True, ALWAYS),
    "preprocess.filter_alpha": (0.012, f"{FIXED}core/frames/preprocess.py"),
    "similarity.max_rotation_deg": (0.3, f"{FIXED}core/places/redundancy.py"),
    "volume.adaptive_texture": (0.6, f"{FIXED}core/map/refinement.py"),
    "tracker.damping": (0.02, f"{FIXED}core/tracking/checks.py"),
    "tracker.color_huber": (0.07, f"{FIXED}core/tracking/tracker.py"),
    "tracker.stop": (5e-4, f"{FIXED}core/tracking/tracker.py"),
    "tracker.stop_coarse": (1e-3, f"{FIXED}core/tracking/tracker.py"),
    "tracker.stop_gain": (3e-3, f"{FIXED}core/tracking/tracker.py"),
    "tracker.min_inliers": (0.15, f"{FIXED}core/tracking/checks.py"),
    "tracker.max_residual": (4.0, f"{FIXED}core/tracking/checks.py"),
    "tracker.min_condition": (1e-4, f"{FIXED}core/tracking/checks.py"),
    "tracker.min_information": (2.3, f"{FIXED}core/tracking/checks.py"),
    "dynamics.noise_threshold": (0.03, f"{FIXED}core/dynamics/detector.py"),
    "dynamics.noise_sigmas": (3.0, f"{FIXED}core/dynamics/detector.py"),
    "dynamics.max_share": (0.9, f"{FIXED}core/tracking/checks.py"),
    "relocalization.max_features": (400, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.image_width": (320, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.ratio": (0.85, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.min_inliers": (15, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.min_share": (0.25, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.min_on_map": (0.4, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.max_distance": (0.06, f"{FIXED}core/places/place_recognition.py"),
    "relocalization.max_angle_deg": (3.0, f"{FIXED}core/places/place_recognition.py"),
    "loops.min_distance": (0.02, f"{FIXED}core/places/loop_closing.py"),
    "loops.min_angle_deg": (0.7, f"{FIXED}core/places/loop_closing.py"),
    "loops.max_drift": (0.1, f"{FIXED}core/places/loop_verification.py"),
    "loops.keep_angle_deg": (5.0, f"{FIXED}core/places/frame_store.py"),
    "submaps.min_readings": (0.2, f"{FIXED}core/places/relocalizer.py"),
    "movers.merge_distance": (0.3, f"{FIXED}core/objects/object_tracker.py"),
    "movers.max_jump": (0.4, f"{FIXED}core/objects/object_tracker.py"),
    "movers.memory": (0.7, f"{FIXED}core/objects/object_tracker.py"),
    "movers.velocity_window": (0.2, f"{FIXED}core/objects/object_tracker.py"),
}
"""By key: value that changes nothing, and the end of the sentence that refuses others."""
LENGTHS = {
    "preprocess.filter_alpha": -1, "dynamics.noise_threshold": 1, "relocalization.max_distance": 1,
    "loops.min_distance": 1, "movers.merge_distance": 1, "movers.max_jump": 1, "tracker.tukey": 1,
    "dynamics.threshold": 1, "tracker.stop": 1, "tracker.stop_coarse": 1,
}  # fmt: skip
"""Exponent of the scene's size in such a value (``dudmap.ranges``)."""


def without_gone(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The nested keys without keys of earlier versions.

    Raises:
        ConfigError: Such a key has another value than the remaining one.
    """
    kept: dict[str, Any] = {}
    sensor = tree.get("sensor")
    size = sensor.get("reference_depth", 1.0) if isinstance(sensor, Mapping) else 1.0
    for part, values in tree.items():
        if isinstance(values, Mapping):
            kept[part] = {key: value for key, value in values.items() if not _is_gone(f"{part}.{key}", value, size)}
        elif not _is_gone(part, values, size):
            kept[part] = values
    return kept


def _is_gone(key: str, value: Any, size: Any) -> bool:  # noqa: ANN401 - TOML values have many types
    if key not in GONE:
        return False
    left, instead = GONE[key]
    if value != left and not _is_scaled(key, value, size):
        raise ConfigError(f"the key {key} = {value!r} is gone; {instead}")
    return True


def _is_scaled(key: str, value: Any, size: Any) -> bool:  # noqa: ANN401 - TOML values have many types
    if key not in LENGTHS or not all(isinstance(number, int | float) and number > 0 for number in (value, size)):
        return False
    scale = min(size, 1.0) if key.startswith("tracker.stop") else size ** LENGTHS[key]
    return bool(abs(value / (GONE[key][0] * scale) - 1) < 0.01)
