"""Registration of the colour image with the camera's motion between depth and colour."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.dynamics.segments import Segmentation, intensity_gradient
from dudmap.frames.color_registration import color_projection, register_color
from dudmap.frames.pyramid import Pyramid
from dudmap.geometry.calibration import Calibration
from dudmap.kernels.cpu import CpuBackend
from dudmap.tracking.frame_view import FrameView


class ColorMotion:
    """Registers colour to depth with the calibration in use, which may change while the camera moves.

    Args:
        config: All parameters.
        given: Calibration with which frames are prepared; None for colour that is registered to depth.

    Attributes:
        calibration: In use; None for images that are taken as they are.
    """

    def __init__(self, config: Config, given: Calibration | None) -> None:
        self.config = config
        self.given = given
        self.calibration = given
        self._backend = CpuBackend()  # of its own: frames are prepared in another thread

    def registered(self, view: FrameView, velocity: NDArray[np.float64]) -> FrameView:
        """The frame with its colours where the camera's motion has taken them.

        Args:
            view: A prepared frame.
            velocity: (6,) twist of the camera per second, its own axes.
        """
        calibration, observation = self.calibration, view.observation
        if calibration is None:
            return view
        moment = abs(calibration.delay + observation.color_offset) + abs(calibration.readout)
        if calibration is self.given and (moment == 0 or not velocity.any()):
            return view  # as prepared
        with view.timer("color"):
            projection = color_projection(calibration, velocity, observation.color_offset)
            recorded = observation.rgb if observation.recorded_rgb is None else observation.recorded_rgb
            rgb = register_color(recorded, observation.depth, observation.camera, projection, self._backend)
            intensity = self._backend.intensity(rgb)
            registered = replace(
                observation, rgb=rgb, intensity=intensity, backend=self._backend, recorded_rgb=recorded, _halvings=[]
            )
            pyramid = Pyramid.of(registered, observation.camera, self.config)

        @cache
        def segmentation() -> Segmentation:
            return replace(view.segmentation(), gradient=intensity_gradient(pyramid.labelled))

        return replace(view, observation=registered, pyramid=pyramid, segmentation=segmentation)
