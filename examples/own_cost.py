"""Register with a robust weight of your own: Tukey's, which is 0 for distances beyond a limit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap import Camera, Config, Slam, TsdfVolume, synthetic
from dudmap.core.frames.observation import Level
from dudmap.core.tracking.tracker import Tracker, TrackingResult


class TukeyTracker(Tracker):
    """Reweights the measurements between registrations by their distance to the map."""

    def align(
        self,
        volume: TsdfVolume,
        levels: list[Level],
        T_init: NDArray[np.float64],
        static_weights: list[NDArray[np.float32]] | None = None,
        *arguments: Any,
        **options: Any,
    ) -> TrackingResult:
        """Register, weigh and register again."""
        static = static_weights or [np.ones_like(level.depth) for level in levels]
        found = super().align(volume, levels, T_init, static, *arguments, **options)
        for _ in range(3):
            T = found.T_world_camera
            weights: list[NDArray[np.float32]] = []
            for level, weight in zip(levels, static, strict=True):
                distances = self.linearize(volume, level, T, weight).residuals[0] / self.sensor.sigma(level.depth)
                part = 1 - np.square(np.nan_to_num(distances, nan=np.inf) / 4.685)  # 95 % efficient for normal errors
                weights.append(np.asarray(weight * np.square(np.maximum(part, 0)), np.float32))
            found = super().align(volume, levels, T, weights, *arguments, **options)
        return found


camera = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
slam = Slam(camera, Config().override(["tracker.huber=1"]))  # Huber's weight is 1 below one metre
slam.tracker = slam.front_end.tracker = TukeyTracker(slam.config.tracker, slam.config.sensor)
for frame in synthetic.sequence("room", movers=("person",), frames=8, camera=camera):
    print(slam.process(frame))
