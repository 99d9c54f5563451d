"""Levenberg-Marquardt steps of a registration on a device: prepared once for a camera and a map, and repeated.

Only the state, some hundred numbers, goes up before the steps of a level and comes down after them. On a GPU the
launches are a graph.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import descent as kernels
from dudmap.gpu.kernels.formulas import Motion
from dudmap.gpu.kernels.structs import RegistrationParameters as DeviceParameters
from dudmap.gpu.kernels.structs import struct
from dudmap.gpu.kernels.surface import LANES
from dudmap.gpu.linearization import GROUPS, PER_THREAD, Images
from dudmap.gpu.memory import OnDevice
from dudmap.gpu.sequence import Sequence
from dudmap.gpu.staging import Staging
from dudmap.gpu.streams import Queue
from dudmap.kernels.parameters import BLOCK, Damping, Descent, RegistrationParameters, VoxelGrid
from dudmap.kernels.registration import NUM_SUMS, SYMMETRIC, normal_equations


class DeviceDescent:
    """The steps for images of one camera and one map.

    Args:
        queue: Where they are made.
        shape: Of the images.
        camera, lattice: Structures of Warp.
        grid: The map.
        limit: Largest number of steps that are tried.
    """

    def __init__(
        self,
        queue: Queue,
        shape: tuple[int, int],
        camera: Any,  # noqa: ANN401 - structures of Warp
        lattice: Any,  # noqa: ANN401
        grid: VoxelGrid,
        limit: int,
    ) -> None:
        self.lattice, self._queue, self._staging = lattice, queue, Staging(queue)
        self._images = tuple(self._empty(shape) for _ in range(3))
        self._residuals = self._empty((4, *shape))
        self._state = wp.zeros(kernels.STATE_SIZE, dtype=wp.float64, device=queue.device)
        self._parameters: RegistrationParameters | None = None
        self._on_device = wp.zeros(1, dtype=DeviceParameters, device=queue.device)
        launches = self._launches(camera, lattice, float(grid.voxel_size), float(grid.sdf_unit))
        first, *others = launches
        self._steps = Sequence(queue, [first, *others * limit])

    def __call__(
        self,
        images: Images,
        grid: VoxelGrid,
        T_world_camera: NDArray[np.float64],
        damping: Damping,
        parameters: RegistrationParameters,
    ) -> Descent | None:
        """The steps from a pose (4, 4) on; None where H is not positive definite, which the host decides upon.

        The residuals stay on the device until one of them is read.
        """
        for own, image in zip(self._images, images, strict=True):
            self._queue.copy(own, image)  # a graph reads from fixed addresses
        if parameters != self._parameters:
            self._queue.copy(self._on_device, wp.array([struct(parameters)], dtype=DeviceParameters, device="cpu"))
            self._parameters = parameters
        self._steps.prepare()  # with the state of the last call, which has ended: nothing is computed
        self._staging.upload(_state(grid, T_world_camera, damping), self._state)
        self._steps.run()
        return self._result(self._staging.download(self._state))

    def _result(self, state: NDArray[np.float64]) -> Descent | None:
        if _part(state, "STATUS")[0] == kernels.INDEFINITE:
            return None
        T, accepted = np.eye(4), int(_part(state, "ACCEPTED")[0])
        T[:3] = _part(state, "POSE").reshape(3, 4)
        equations = None
        if accepted >= 0:
            residuals = self._empty((2, *self._residuals.shape[1:]))
            self._queue.copy(residuals, self._residuals[2 * accepted : 2 * accepted + 2])
            equations = normal_equations(_part(state, "SUMS").copy(), OnDevice(residuals, self._queue))
        settled = _part(state, "STATUS")[0] == kernels.SETTLED
        return Descent(T, equations, int(_part(state, "USED")[0]), bool(settled))

    def _launches(self, camera: Any, lattice: Any, voxel_size: float, sdf_unit: float) -> list[Any]:  # noqa: ANN401
        """The first step, then the launches of each one more."""
        threads = -(-self._images[0].size // (PER_THREAD * LANES)) * LANES
        partial = self._empty((NUM_SUMS, threads))
        parts, state = self._empty((NUM_SUMS, GROUPS), wp.float64), self._state
        motion = wp.zeros(1, dtype=Motion, device=self._queue.device)
        return [
            self._recorded(kernels.advance, 1, 1, state, motion),
            self._recorded(
                kernels.linearize_trial, threads, *self._images, camera, motion, lattice, voxel_size, sdf_unit,
                self._on_device, PER_THREAD, state, self._residuals, partial,
            ),
            self._recorded(kernels.add_up_trial, parts.shape, partial, GROUPS, state, parts),
            self._recorded(kernels.finish_trial, NUM_SUMS, parts, state),
            self._recorded(kernels.advance, 1, 0, state, motion),
        ]  # fmt: skip

    def _recorded(self, kernel: Any, dim: Any, *arguments: Any) -> Any:  # noqa: ANN401
        return wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._queue.device, record_cmd=True)

    def _empty(self, shape: Any, dtype: Any = wp.float32) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=dtype, device=self._queue.device)


def _state(grid: VoxelGrid, T_world_camera: NDArray[np.float64], damping: Damping) -> NDArray[np.float64]:
    """The state (STATE_SIZE,) before the first step."""
    state, m = np.zeros(kernels.STATE_SIZE), damping.basis.shape[1]
    _part(state, "POSE")[:] = T_world_camera[:3].reshape(-1)
    sums = _part(state, "SUMS")
    sums[SYMMETRIC] = damping.H
    sums[21:27], sums[kernels.COST] = damping.b, damping.cost
    _part(state, "BASIS").reshape(6, 6)[:, :m] = damping.basis
    _part(state, "ORIGIN")[:] = grid.origin * BLOCK
    numbers = {
        "DIMENSIONS": m, "VOXEL": grid.voxel_size, "DAMPING": damping.damping, "LIMIT": damping.limit,
        "STOP": damping.stop, "STOP_GAIN": damping.stop_gain, "STATUS": kernels.RUNNING, "ACCEPTED": -1,
    }  # fmt: skip
    for name, value in numbers.items():
        _part(state, name)[:] = value
    return state


def _part(state: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """A part of the state by its name in the kernels."""
    return state[kernels.PLACES[name] :][: kernels.SIZES[name]]
