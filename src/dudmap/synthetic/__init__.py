"""Synthetic recordings of analytic scenes with moving objects and exact ground truth: poses, masks and surface.

The renderer is imported when it is first used, so that importing this package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dudmap.synthetic.faults import SensorFaults
    from dudmap.synthetic.setup import sequence

__all__ = ["SensorFaults", "names", "sequence"]

_MODULES = {"SensorFaults": "dudmap.synthetic.faults", "sequence": "dudmap.synthetic.setup"}


def __getattr__(name: str) -> object:
    """Import the module of a public name on the first access to it."""
    if name not in _MODULES:
        raise AttributeError(f"module 'dudmap.synthetic' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def names() -> dict[str, list[str]]:
    """Names of all scenes, movers, camera paths, situations, noise models and sensors."""
    from dudmap.synthetic.cameras import CAMERAS
    from dudmap.synthetic.movers import MOVERS
    from dudmap.synthetic.paths import FOLLOW, PATHS
    from dudmap.synthetic.rooms import SCENES
    from dudmap.synthetic.sensors import SENSORS
    from dudmap.synthetic.situations import SITUATIONS

    return {
        "scenes": list(SCENES),
        "movers": list(MOVERS),
        "camera_paths": [*PATHS, FOLLOW],
        "situations": list(SITUATIONS),
        "noise": list(SENSORS),
        "sensors": list(CAMERAS),
    }
