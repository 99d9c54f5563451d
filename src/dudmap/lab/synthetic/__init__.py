"""Synthetic recordings of analytic scenes with moving objects and exact ground truth: poses, masks and surface.

The renderer is imported when it is first used, so that importing this package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dudmap.lab.synthetic.faults import SensorFaults
    from dudmap.lab.synthetic.setup import sequence

__all__ = ["SensorFaults", "names", "sequence"]

_MODULES = {"SensorFaults": "dudmap.lab.synthetic.faults", "sequence": "dudmap.lab.synthetic.setup"}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'dudmap.lab.synthetic' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def names() -> dict[str, list[str]]:
    """Names of all scenes, movers, camera paths, situations, noise models and sensors."""
    from dudmap.lab.synthetic.movers import MOVERS
    from dudmap.lab.synthetic.paths import FOLLOW, PATHS
    from dudmap.lab.synthetic.rooms import SCENES
    from dudmap.lab.synthetic.sensors import CAMERAS, SENSORS
    from dudmap.lab.synthetic.setup import SITUATIONS

    return {
        "scenes": list(SCENES),
        "movers": list(MOVERS),
        "camera_paths": [*PATHS, FOLLOW],
        "situations": list(SITUATIONS),
        "noise": list(SENSORS),
        "sensors": list(CAMERAS),
    }
