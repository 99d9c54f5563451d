"""Difficult situations, each a modification of an ordinary sequence."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.errors import ConfigError
from dudmap.lab.synthetic.motion import smooth_step
from dudmap.lab.synthetic.movers import SyntheticMover, rigid
from dudmap.lab.synthetic.scene import Material, Scene, box, pose

Array = NDArray[np.float64]
CAP_DISTANCE = 0.16
"""Distance of the cover from the camera, metres."""


@dataclass(frozen=True)
class Situation:
    """Modification of an ordinary sequence.

    Attributes:
        movers: Default movers.
        camera_path: Default camera path.
        start_dynamic: Whether movers are in view in the first frame.
        covered: Intervals, as shares of the duration, in which the camera is covered.
        elsewhere: Intervals, as shares of the duration, in which the camera looks at another part of the scene.
    """

    movers: tuple[str, ...]
    camera_path: str = "handheld"
    start_dynamic: bool = False
    covered: tuple[tuple[float, float], ...] = ()
    elsewhere: tuple[tuple[float, float], ...] = field(default=())


SITUATIONS: dict[str, Situation] = {
    "people_at_start": Situation(("people",), start_dynamic=True),
    "follow": Situation(("wanderer",), camera_path="follow", start_dynamic=True),
    "blocked": Situation(("person",), covered=((0.40, 0.55),)),
    "kidnapped": Situation((), covered=((0.33, 0.38), (0.60, 0.65)), elsewhere=((0.36, 0.63),)),
    "stops": Situation(("stopping_cart",)),
    "starts": Situation(("starting_cart",)),
    "put_down": Situation(("carried_box",)),
    "taken_away": Situation(("removed_box",)),
}


def find_situation(name: str) -> Situation:
    """Situation of the given name.

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in SITUATIONS:
        raise ConfigError(f"unknown situation {name!r}; known situations: {', '.join(SITUATIONS)}")
    return SITUATIONS[name]


def carried_elsewhere(Ts: Array, scene: Scene, times: Array, spans: tuple[tuple[float, float], ...]) -> Array:
    """Poses (N, 4, 4) rotated by 150 degrees about the vertical at home in the intervals (shares of the duration)."""
    around = pose(scene.home[:3, 3], yaw=150.0) @ se3.inverse(pose(scene.home[:3, 3]))
    out = Ts.copy()
    for begin, end in spans:
        away = (times >= begin * times[-1]) & (times < end * times[-1])
        out[away] = around @ out[away]
    return out


def cover(
    times: Array, T_world_camera: Callable[[float], Array], spans: tuple[tuple[float, float], ...]
) -> SyntheticMover:
    """Dark sheet in front of the camera, closer than the sensor range, in the intervals (shares of the duration)."""
    sheet = box((0, 0, 0), (0.5, 0.4, 0.01), Material("denim", (2.0, 2.0), tint=(0.35, 0.3, 0.3)))
    duration = float(times[-1])

    def aside(t: float) -> float:
        """Position of the sheet: 1 out of view, 0 covering the view."""
        closed = [
            smooth_step((t - begin * duration) / 0.15 + 1.0) - smooth_step((t - end * duration) / 0.15)
            for begin, end in spans
        ]
        return 1.0 - max(closed)

    def reference(t: float) -> Array:
        return T_world_camera(t) @ pose((0.6 * aside(t), 0.0, CAP_DISTANCE))

    return rigid("cover", [sheet], reference, lambda t: aside(t) < 1.0)
