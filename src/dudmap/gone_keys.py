"""Configuration keys of earlier versions: the value that is left, and the key that takes the place of other values."""

from collections.abc import Mapping
from typing import Any

from dudmap.errors import ConfigError

THESIS = "--system thesis runs the system of the thesis, with the parameters of the section thesis"
ALWAYS = "the part is always on"

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
}
"""Value that changes nothing, and the end of the sentence that refuses any other, by key."""


def without_gone(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The nested keys without those of earlier versions.

    Raises:
        ConfigError: A key that is gone has another value than the one that is left.
    """
    kept: dict[str, Any] = {}
    for part, values in tree.items():
        if isinstance(values, Mapping):
            kept[part] = {name: value for name, value in values.items() if not _is_gone(f"{part}.{name}", value)}
        elif not _is_gone(part, values):
            kept[part] = values
    return kept


def _is_gone(key: str, value: Any) -> bool:  # noqa: ANN401 - TOML values have many types
    if key not in GONE:
        return False
    left, instead = GONE[key]
    if value != left:
        raise ConfigError(f"the key {key} = {value!r} is gone; {instead}")
    return True
