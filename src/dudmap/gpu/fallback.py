"""A device with the CPU behind it: what the device cannot do is done there, and the run goes on."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.gpu import faults
from dudmap.gpu.backend import WarpBackend
from dudmap.gpu.memory import DeviceImage, OnDevice
from dudmap.kernels import block_index
from dudmap.kernels.backend import OPERATIONS
from dudmap.kernels.cpu import CpuBackend
from dudmap.kernels.evidence import ReadingNoise
from dudmap.kernels.level_backend import FinerLevels
from dudmap.kernels.mirror import Mirror
from dudmap.kernels.parameters import (
    DepthView,
    Descent,
    FusedBlocks,
    ImageStack,
    NormalEquations,
    VoxelGrid,
    to_lattice,
)
from dudmap.kernels.segmentation import SegmentImage

KEPT_EVERY = 100
"""Fused frames after which the host takes over what the device has written, some ten megabytes for the blocks in view:
so many are missing in the map at most if the device is lost. It does so more often at the start, after 1, 2, 4, 8, ...
frames, so that at least half of a small map is there."""

ON_HOST = {"allocate_touched": "touched_cells", "fuse_near": "fuse", "record_free": "observe_free"}
"""Operations that take the place of another one and the host's part of the work; what is told names that one."""


class FallbackBackend:
    """``Backend`` on a device, each operation of which the CPU takes over when the device fails.

    A device that is lost is left for good: the map then is as the host has it. One that has too little memory for an
    operation is left for this once, and one that cannot hold the map is left by this map.

    Args:
        device: Name of the device in Warp.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self._on_device, self._on_cpu = WarpBackend(device), CpuBackend()
        self._is_full = False
        self._num_fused, self._num_kept = Counter[float](), Counter[float]()  # by the voxel size of the level

    def perform(self, name: str, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401
        """Result of an operation of ``Backend``."""
        if self._is_full:
            self._leave(arguments)  # also finer levels that were not among the arguments before
        if not (self._is_full or faults.is_lost(self.device)):
            try:
                result = getattr(self._on_device, name)(*arguments)
                if isinstance(result, NormalEquations):
                    return result._replace(residuals=_Residuals(self, result.residuals, arguments))
                if isinstance(result, Descent) and result.equations is not None:
                    grid, *images, _damping, parameters = arguments
                    T_grid_camera = to_lattice(result.T_world_camera, grid.voxel_size, grid.origin)
                    again = grid, *images[:-1], T_grid_camera, parameters
                    residuals = _Residuals(self, result.equations.residuals, again)
                    return result._replace(equations=result.equations._replace(residuals=residuals))
                if isinstance(result, DeviceImage):
                    return _Image(self, result, name, arguments)
                if isinstance(result, ReadingNoise):
                    images: list[Any] = [_Image(self, one, name, arguments, n) for n, one in enumerate(result)]
                    return ReadingNoise(*images)
                if _ends_fusion(name, arguments):
                    self._keep(arguments[0])
                return result
            except Exception as error:
                faults.handle(error, self.device, f"the operation {ON_HOST.get(name, name)}")
                if isinstance(error, faults.DeviceFullError):
                    self._leave(arguments)
        return self.perform_on_cpu(name, arguments)

    def perform_on_cpu(self, name: str, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401
        """The same by the CPU, whatever the device can do."""
        if name in block_index.OPERATIONS:
            return False
        found = [self._on_host(value) for value in arguments]
        result = getattr(self._on_cpu, name)(*found)
        if isinstance(result, FusedBlocks):
            for array in _mirrors(arguments[:1]):
                if array is not arguments[0].window:
                    array.wrote(result.slots)
        return result

    def _on_host(self, value: Any) -> Any:  # noqa: ANN401
        """An argument in the host's memory: a view with its tiles, an image."""
        if isinstance(value, DepthView):
            return self._on_cpu.view(value.depth, value.intrinsics, value.T_grid_camera, value.T_camera_world)
        if isinstance(value, SegmentImage):
            return value._replace(sigma=np.asarray(value.sigma))
        return np.asarray(value) if isinstance(value, DeviceImage) else value

    def _leave(self, arguments: tuple[Any, ...]) -> None:
        """Bring the map to the host, which has all of it from now on."""
        self._is_full = True
        for grid in arguments:
            if isinstance(grid, VoxelGrid) and grid.index is not None:
                grid.index.leave()
        for array in _mirrors(arguments):
            array.detach()

    def _keep(self, grid: VoxelGrid) -> None:
        """Bring the voxels to the host now and then."""
        level = grid.voxel_size
        self._num_fused[level] += 1
        kept = self._num_kept[level]
        if self._num_fused[level] - kept >= min(max(kept, 1), KEPT_EVERY):
            self._num_kept[level] = self._num_fused[level]
            grid.on_host()


class _Image(DeviceImage):
    """Result of an operation on a device, which the CPU computes anew if the device fails before it was read.

    Args:
        backend, image, name, arguments: The operation and its result.
        number: Of the image, where the result has several.
    """

    def __init__(
        self,
        backend: FallbackBackend,
        image: Any,  # noqa: ANN401 - a DeviceImage
        name: str,
        arguments: tuple[Any, ...],
        number: int | None = None,
    ) -> None:
        super().__init__(image.twin, image.queue, image.dtype)
        self._backend, self._name, self._arguments, self._number = backend, name, arguments, number

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:  # noqa: ANN401
        if not faults.is_lost(self._backend.device):
            try:
                return super().__array__(dtype, copy)
            except Exception as error:
                faults.handle(error, self._backend.device, f"the result of {self._name}")
        result = self._backend.perform_on_cpu(self._name, self._arguments)
        return np.asarray(result if self._number is None else result[self._number], dtype)


class _Residuals:
    """Residual images of a linearisation on a device, which the CPU computes anew if the device fails meanwhile."""

    def __init__(self, backend: FallbackBackend, images: ImageStack, arguments: tuple[Any, ...]) -> None:
        self._backend, self._images, self._arguments = backend, images, arguments

    def __getitem__(self, number: int) -> NDArray[np.float32]:
        if isinstance(self._images, OnDevice):
            try:
                return self._images[number]
            except Exception as error:
                faults.handle(error, self._backend.device, "the residuals")
            self._images = self._backend.perform_on_cpu("linearize", self._arguments).residuals
        return self._images[number]


def _mirrors(arguments: tuple[Any, ...]) -> list[Mirror]:
    """Arrays of the map among the arguments of an operation, which may have a copy on a device."""
    values = [value for one in arguments for value in (one if isinstance(one, VoxelGrid | FinerLevels) else (one,))]
    return [value for value in values if isinstance(value, Mirror)]


def _ends_fusion(name: str, arguments: tuple[Any, ...]) -> bool:
    """Whether an operation is the last one of a frame that writes to the map on the device."""
    if name == "fuse_near":
        *_, release_as, _parameters = arguments
        return release_as < 0
    return name in ("fuse", "record_free")


def _operation(name: str) -> Callable[..., Any]:
    def operation(self: FallbackBackend, *arguments: Any) -> Any:  # noqa: ANN401
        return self.perform(name, arguments)

    operation.__doc__ = f"See ``Backend.{name}``."
    return operation


for _name in OPERATIONS:
    setattr(FallbackBackend, _name, _operation(_name))
