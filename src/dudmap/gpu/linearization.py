"""The launches of a linearisation, recorded once for a camera and a map, and repeated for every image and pose.

To prepare launches takes longer than a GPU computes; of the arguments only images, weights and the pose change.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import surface
from dudmap.gpu.kernels.formulas import Motion
from dudmap.gpu.kernels.structs import struct
from dudmap.gpu.memory import OnDevice
from dudmap.gpu.streams import Queue
from dudmap.kernels.parameters import NormalEquations, RegistrationParameters
from dudmap.kernels.registration import NUM_SUMS, normal_equations

GROUPS = 64
"""Partial sums that are left after the first level of a sum."""
PER_THREAD = 8
"""Pixels that one thread adds up in a linearisation."""
Images = tuple[Any, Any, Any]
"""Depth, intensity and weights (h, w), arrays of Warp."""


class Linearization:
    """Linearisations of images of one camera with one map.

    Args:
        queue: Where they are made.
        images: Depth, intensity and weights (h, w) on the device, of which others may follow.
        camera, lattice: Structures of Warp.
        parameters: Of the cost, of which others may follow.
        voxel_size, sdf_unit: Metres.
    """

    def __init__(
        self,
        queue: Queue,
        images: Images,
        camera: Any,  # noqa: ANN401 - structures of Warp
        lattice: Any,  # noqa: ANN401
        parameters: RegistrationParameters,
        voxel_size: float,
        sdf_unit: float,
    ) -> None:
        self.lattice, self._queue, self._shape = lattice, queue, images[0].shape
        device = queue.device
        self._images, self._parameters = images, parameters
        threads = -(-images[0].size // (PER_THREAD * surface.LANES)) * surface.LANES
        self._partial = wp.empty((NUM_SUMS, threads), dtype=wp.float32, device=device)
        self._parts = wp.empty((NUM_SUMS, GROUPS), dtype=wp.float64, device=device)
        self._sums = wp.empty(NUM_SUMS, dtype=wp.float64, device=device)
        residuals = wp.empty((2, *self._shape), dtype=wp.float32, device=device)
        self._first = self._recorded(
            surface.linearize, threads, *images, camera, Motion(), lattice, voxel_size, sdf_unit, struct(parameters),
            PER_THREAD, residuals, self._partial,
        )  # fmt: skip
        self._others = (
            self._recorded(surface.add_up, self._parts.shape, self._partial, GROUPS, self._parts),
            self._recorded(surface.finish, NUM_SUMS, self._parts, self._sums),
        )

    def __call__(
        self, images: Images, parameters: RegistrationParameters, T_grid_camera: NDArray[np.float32]
    ) -> NormalEquations:
        """Normal equations at a pose (3, 4), whose residuals stay on the device until one of them is read."""
        residuals = wp.empty((2, *self._shape), dtype=wp.float32, device=self._queue.device)
        for name, image, last in zip(("depth", "intensity", "weights"), images, self._images, strict=True):
            if image is not last:
                self._first.set_param_by_name(name, image)
        if parameters != self._parameters:
            self._first.set_param_by_name("p", struct(parameters))
        self._images, self._parameters = images, parameters  # the recorded launch holds addresses only
        self._first.set_param_by_name("t", Motion(*T_grid_camera.reshape(-1).tolist()))
        self._first.set_param_by_name("residuals", residuals)
        for launch in (self._first, *self._others):
            self._queue.repeat(launch)
        return normal_equations(self._queue.download(self._sums), OnDevice(residuals, self._queue))

    def _recorded(self, kernel: Any, dim: Any, *arguments: Any) -> Any:  # noqa: ANN401
        return wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._queue.device, record_cmd=True)
