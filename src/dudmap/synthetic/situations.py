"""Situations that break trackers, each a small change to an ordinary sequence."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import ConfigError
from dudmap.geometry import se3
from dudmap.synthetic.motion import smooth_step
from dudmap.synthetic.movers import Mover, rigid
from dudmap.synthetic.scene import Material, Scene, box, pose

Array = NDArray[np.float64]
CAP_DISTANCE = 0.16  # metres in front of the camera


@dataclass(frozen=True)
class Situation:
    """What differs from an ordinary sequence.

    Attributes:
        movers: The movers, unless others are asked for.
        camera_path: The camera path, unless another is asked for.
        start_dynamic: Movers in view at the first frame.
        covered: Spans, as shares of the duration, in which something covers the camera.
        elsewhere: Spans, as shares, in which the camera is turned to another part of the world.
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
    """Situation by name.

    Raises:
        ConfigError: There is none of this name.
    """
    if name not in SITUATIONS:
        raise ConfigError(f"unknown situation {name!r}; known situations: {', '.join(SITUATIONS)}")
    return SITUATIONS[name]


def carried_elsewhere(Ts: Array, scene: Scene, times: Array, spans: tuple[tuple[float, float], ...]) -> Array:
    """Poses (N, 4, 4) turned by 150 degrees about the vertical through home during the spans (shares of the time)."""
    around = pose(scene.home[:3, 3], yaw=150.0) @ se3.inverse(pose(scene.home[:3, 3]))
    out = Ts.copy()
    for begin, end in spans:
        away = (times >= begin * times[-1]) & (times < end * times[-1])
        out[away] = around @ out[away]
    return out


def cover(times: Array, T_world_camera: Callable[[float], Array], spans: tuple[tuple[float, float], ...]) -> Mover:
    """A dark sheet that slides in front of the camera, closer than any sensor measures, during the spans (shares)."""
    sheet = box((0, 0, 0), (0.5, 0.4, 0.01), Material("denim", (2.0, 2.0), tint=(0.35, 0.3, 0.3)))
    duration = float(times[-1])

    def aside(t: float) -> float:
        """1 out of view, 0 covering."""
        closed = [
            smooth_step((t - begin * duration) / 0.15 + 1.0) - smooth_step((t - end * duration) / 0.15)
            for begin, end in spans
        ]
        return 1.0 - max(closed)

    def reference(t: float) -> Array:
        return T_world_camera(t) @ pose((0.6 * aside(t), 0.0, CAP_DISTANCE))

    return rigid("cover", [sheet], reference, lambda t: aside(t) < 1.0)
