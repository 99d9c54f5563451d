"""Stream of people that covers a share of the image; impossible shares raise a ``ConfigError``."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError
from dudmap.lab.synthetic.motion import Figure
from dudmap.lab.synthetic.movers import Staging, SyntheticMover, placed
from dudmap.lab.synthetic.render import Renderer
from dudmap.lab.synthetic.scene import pose

ENTRY_SPEED = 3.0
"""Speed at which a slow crowd enters, m/s."""


class Crowd:
    """People walking in a line across the view, who re-enter on the other side.

    Args:
        staging: Scene, random numbers, speed, duration, start.
        density: 0 (few, far away) to 1 (a closed line before the camera).
    """

    def __init__(self, staging: Staging, density: float) -> None:
        scene, size = staging.scene, staging.scene.mover_scale
        self.speed = staging.pace(1.0)
        self.spacing = size * float(np.exp((1 - density) * np.log(6.0) + density * np.log(0.11)))
        self.distance = size * (2.3 - 1.6 * density**0.7)
        home = scene.home
        forward = np.array([home[0, 2], home[1, 2]]) / np.hypot(home[0, 2], home[1, 2])
        self.direction = np.array([forward[1], -forward[0]])
        self.middle = home[:2, 3] + self.distance * forward
        self.reach = 0.75 * self.distance + 1.0 * size  # half the length of the lane
        self.count = int(np.ceil(2 * self.reach / self.spacing))
        self.lane = self.count * self.spacing
        self.hurry = max(self.speed, ENTRY_SPEED * size)
        self.steady_from = 0.0 if staging.start_dynamic else 0.5 + self.lane / self.hurry  # the whole lane is occupied
        self.staging = staging
        stride = 1.35 * float(np.clip(np.sqrt(self.speed / size / 1.2), 0.35, 1.2))
        rng = np.random.default_rng(staging.rng.integers(2**32))
        self.figures = [Figure(rng, number, size, stride) for number in range(min(self.count, 5))]

    def advanced(self, t: float) -> float:
        """Distance walked at ``t``, metres; from 0.5 s without ``start_dynamic``."""
        if t <= self.steady_from and not self.staging.start_dynamic:
            return self.hurry * (t - 0.5)
        return self.lane + self.speed * (t - self.steady_from)

    def movers(self) -> list[SyntheticMover]:
        """Movers of the crowd, one per person."""
        return [self._person(number) for number in range(self.count)]

    def _person(self, number: int) -> SyntheticMover:
        figure, ground = self.figures[number % len(self.figures)], self.staging.scene.ground
        side = 0.10 * self.staging.scene.mover_scale * ((number * 7) % 5 - 2)  # lateral offsets
        yaw = float(np.degrees(np.arctan2(self.direction[1], self.direction[0])))
        across = np.array([-self.direction[1], self.direction[0]])

        def way(t: float) -> float:
            return self.advanced(t) - number * self.spacing

        def reference(t: float) -> NDArray[np.float64]:
            x = way(t) % self.lane - self.lane / 2
            return pose((*(self.middle + x * self.direction + side * across), ground), yaw)

        def parts(t: float) -> NDArray[np.float64]:
            return figure.poses(reference(t), way(t) + 0.31 * number)

        return SyntheticMover("person", figure.primitives, parts, reference, lambda t: way(t) >= 0, settles=False)


def _coverage(crowd: Crowd, times: NDArray[np.float64], Ts_world_camera: NDArray[np.float64]) -> float:
    scene, movers = crowd.staging.scene, crowd.movers()
    camera = Camera(66.0, 66.0, 39.5, 29.5, 80, 60)
    renderer = Renderer(scene, scene.primitives + [p for mover in movers for p in mover.primitives])
    shares = []
    for t, T in zip(times, Ts_world_camera, strict=True):
        image = renderer.render(camera, T, *placed(movers, t), with_color=False)
        shares.append(float((image.primitive >= len(scene.primitives)).mean()))
    return float(np.mean(shares))


def crowd_of(
    coverage: float, staging: Staging, times: NDArray[np.float64], Ts_world_camera: NDArray[np.float64]
) -> Crowd:
    """Crowd that covers ``coverage`` of the image on average, by bisection, in frames at (N,) seconds with poses (N, 4,
    4)."""
    if not 0.02 <= coverage <= 0.95:
        raise ConfigError(f"coverage is {coverage}; expected a share of the image from 0.02 to 0.95")
    seed = int(staging.rng.integers(2**32))

    def attempt(density: float) -> tuple[Crowd, float]:
        rng = np.random.default_rng(seed)
        crowd = Crowd(Staging(staging.scene, rng, staging.speed, staging.duration, staging.start_dynamic), density)
        steady = np.flatnonzero(times >= min(crowd.steady_from, 0.75 * times[-1]))
        chosen = steady[np.unique(np.linspace(0, len(steady) - 1, 8).astype(int))]
        return crowd, _coverage(crowd, times[chosen], Ts_world_camera[chosen])

    low, high = 0.0, 1.0
    best, reached = attempt(high)
    if reached < coverage - 0.02:
        raise ConfigError(
            f"coverage is {coverage}, but the densest crowd in scene {staging.scene.name!r} covers {reached:.2f} "
            "of the image; request less or use another scene"
        )
    for _ in range(8):
        middle = (low + high) / 2
        crowd, share = attempt(middle)
        if abs(share - coverage) < abs(reached - coverage):
            best, reached = crowd, share
        low, high = (middle, high) if share < coverage else (low, middle)
    return best
