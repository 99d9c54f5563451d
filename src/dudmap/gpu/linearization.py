"""The launches of a linearisation, recorded once for an image and repeated for every pose that a registration tries.

To prepare the launches takes longer than a GPU computes: all arguments but the pose and the residuals stay as they are
from one iteration to the next.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import surface
from dudmap.gpu.kernels.formulas import Motion
from dudmap.gpu.memory import OnDevice
from dudmap.kernels.parameters import NormalEquations
from dudmap.kernels.registration import NUM_SUMS, SYMMETRIC

GROUPS = 64
"""Partial sums that are left after the first level of a sum."""
PER_THREAD = 8
"""Pixels that one thread adds up in a linearisation."""


class Linearization:
    """Linearisations of one image with one map.

    Args:
        device: Name of the device.
        images: Depth, intensity and weights (h, w) on the device.
        camera, lattice, parameters: Structures of Warp.
        voxel_size, sdf_unit: Metres.
    """

    def __init__(
        self,
        device: str,
        images: tuple[Any, Any, Any],
        camera: Any,  # noqa: ANN401 - structures of Warp
        lattice: Any,  # noqa: ANN401
        parameters: Any,  # noqa: ANN401
        voxel_size: float,
        sdf_unit: float,
    ) -> None:
        self._device, self._shape = device, images[0].shape
        threads = -(-images[0].size // (PER_THREAD * surface.LANES)) * surface.LANES
        partial = wp.empty((NUM_SUMS, threads), dtype=wp.float32, device=device)
        parts = wp.empty((NUM_SUMS, GROUPS), dtype=wp.float64, device=device)
        self._sums = wp.empty(NUM_SUMS, dtype=wp.float64, device=device)
        residuals = wp.empty((2, *self._shape), dtype=wp.float32, device=device)
        inputs = [*images, camera, Motion(), lattice, voxel_size, sdf_unit, parameters, PER_THREAD, residuals, partial]
        self._in_use = inputs, parts  # the recorded launches hold addresses only
        self._first = self._recorded(surface.linearize, threads, *inputs)
        self._others = (
            self._recorded(surface.add_up, parts.shape, partial, GROUPS, parts),
            self._recorded(surface.finish, NUM_SUMS, parts, self._sums),
        )

    def __call__(self, T_grid_camera: NDArray[np.float32]) -> NormalEquations:
        """Normal equations at a pose (3, 4), whose residuals stay on the device until one of them is read."""
        residuals = wp.empty((2, *self._shape), dtype=wp.float32, device=self._device)
        self._first.set_param_by_name("t", Motion(*T_grid_camera.reshape(-1).tolist()))
        self._first.set_param_by_name("residuals", residuals)
        self._first.launch()
        for launch in self._others:
            launch.launch()
        total = self._sums.numpy().copy()
        return NormalEquations(
            total[SYMMETRIC], total[21:27], float(total[27]), int(total[28]), float(total[29]), float(total[30]),
            float(total[31]), OnDevice(residuals),
        )  # fmt: skip

    def _recorded(self, kernel: Any, dim: Any, *arguments: Any) -> Any:  # noqa: ANN401
        return wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._device, record_cmd=True)
