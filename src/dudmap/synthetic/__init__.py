"""Analytic worlds with moving things: exact depth, colour, poses, masks and surface.

Importing this package is cheap; the renderer is loaded when a sequence is made.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dudmap.synthetic.recording import sequence

__all__ = ["names", "sequence"]


def __getattr__(name: str) -> object:
    """Load the renderer when ``sequence`` is first asked for."""
    if name != "sequence":
        raise AttributeError(f"module 'dudmap.synthetic' has no attribute {name!r}")
    from dudmap.synthetic.recording import sequence

    return sequence


def names() -> dict[str, list[str]]:
    """Known names of scenes, movers, camera paths, situations and noise models."""
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
    }
