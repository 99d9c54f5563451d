"""Preparation of a frame on a device: filter, intensities, pyramid and segments, in a queue of its own.

While the main queue processes a frame, the next one is uploaded and prepared beside it by the thread that reads it.
"""

import threading
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.components import Components
from dudmap.gpu.kernels import images as kernels
from dudmap.gpu.memory import Images
from dudmap.gpu.staging import WARP_TYPES, ImagePool, Staging
from dudmap.gpu.streams import gate, main_queue, own_queue
from dudmap.kernels.antialiasing import SAME_SURFACE
from dudmap.kernels.parameters import FilterParameters

SHARES = 0.299 / 255, 0.587 / 255, 0.114 / 255
"""Shares of red, green and blue in the intensity."""


class Preparation:
    """Operations on the images of one frame after another.

    Args:
        device: Name of the device in Warp.
        images: Arrays of the device that the host has equals of.
    """

    def __init__(self, device: str, images: Images) -> None:
        self._queue, self._images = own_queue(device), images
        self._staging, self._pool = Staging(self._queue), ImagePool(self._queue, main_queue(device))
        self._scratch: dict[tuple[Any, ...], Any] = {}
        self._weights: tuple[NDArray, Any] = np.empty(0), None
        self._lock, self._gate = threading.RLock(), gate(device)
        # another thread may wait for events, which no thread may do while this one captures a graph
        self._components = Components(self._queue, self._buffer, self._staging.download, as_graph=False)

    def filter(self, depth: NDArray[np.float32], parameters: FilterParameters) -> NDArray[np.float32]:
        """See ``Backend.filter``."""
        p = parameters
        with self._lock, self._gate.use():
            steps: list[tuple[Any, tuple[Any, ...]]] = [(kernels.limit_depth, (p.depth_min, p.depth_max))]
            if p.drop_mixed:
                steps.append((kernels.drop_mixed, (p.alpha, p.hole_noise, p.steepest)))
            if p.fill_holes:
                steps.append((kernels.fill_holes, (p.alpha, p.hole_noise)))
            if p.smooth:
                weights = self._spatial(p)
                steps += [(kernels.bilateral_line, (p.alpha, weights, *along)) for along in ((1, 0), (0, 1))]
            image = self._up(depth, "raw")
            for number, (kernel, arguments) in enumerate(steps, 1):
                last = number == len(steps)
                out = self._pool.take(depth.shape) if last else self._buffer(depth.shape, wp.float32, number % 2)
                self._queue.launch(kernel, depth.shape, image, *arguments, out)
                image = out
            return self._down(image)

    def intensity(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See ``Backend.intensity``."""
        with self._lock, self._gate.use():
            out = self._pool.take(rgb.shape[:2])
            self._queue.launch(kernels.intensities, rgb.shape[:2], self._up(rgb, "raw"), *SHARES, out)
            return self._down(out)

    def footprint_colors(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], focal: float, voxel_size: float
    ) -> NDArray[np.uint8]:
        """See ``Backend.footprint_colors``; the result is read-only."""
        with self._lock, self._gate.use():
            out = self._pool.take(color.shape, wp.uint8)
            arguments = self._up(depth, "depth"), self._up(color, "raw"), focal * voxel_size, SAME_SURFACE * voxel_size
            self._queue.launch(kernels.footprint_means, depth.shape, *arguments, out)
            return self._down(out)

    def halve(
        self, depth: NDArray[np.float32], intensity: NDArray[np.float32], tolerance: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``Backend.halve``."""
        shape = depth.shape[0] // 2, depth.shape[1] // 2
        with self._lock, self._gate.use():
            z, shade = self._up(depth, "depth"), self._up(intensity, "intensity")
            out = self._pool.take(shape), self._pool.take(shape)
            self._queue.launch(kernels.halve, shape, z, shade, tolerance, *out)
            return self._down(out[0]), self._down(out[1])

    def segment_surface(
        self,
        depth: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        reach: int,
        normal_reach: int,
        sine: float,
    ) -> tuple[NDArray[np.int32], int]:
        """See ``Backend.segment_surface``."""
        with self._lock, self._gate.use():
            images = self._up(depth, "depth"), self._up(tolerance, "tolerance")
            twin = self._pool.take(depth.shape, wp.int32)
            labels, count = self._components.segment_surface(*images, intrinsics, reach, normal_reach, sine, twin)
            self._remember(labels, twin)
            return labels, count

    def _up(self, array: NDArray, use: str) -> Any:  # noqa: ANN401 - an array of Warp
        """The array on the device; one that is not there already is copied to a buffer of this queue alone."""
        twin = self._images.twin(array)
        if twin is None:
            twin = self._buffer(array.shape, WARP_TYPES[array.dtype], use)
            self._staging.upload(array, twin)
        return twin

    def _down(self, image: Any) -> NDArray:  # noqa: ANN401 - an array of Warp
        """A copy in the host's memory, read-only, whose equal on the device is used again when it has gone."""
        array = self._staging.download(image)
        self._remember(array, image)
        return array

    def _remember(self, array: NDArray, image: Any) -> None:  # noqa: ANN401
        """The image on the device is the array's equal until that has gone."""
        array.flags.writeable = False
        self._images.remember(array, image, self._pool.give_back)

    def _buffer(self, shape: tuple[int, ...], dtype: Any, use: Any) -> Any:  # noqa: ANN401
        """The array of this queue alone for a use, which is overwritten in the order of the queue."""
        key = (*shape, dtype, use)
        if key not in self._scratch:
            self._scratch[key] = self._pool.take(shape, dtype)
        return self._scratch[key]

    def _spatial(self, parameters: FilterParameters) -> Any:  # noqa: ANN401
        """Spatial weights of the filter on the device."""
        weights = parameters.spatial_weights
        if not np.array_equal(weights, self._weights[0]):
            self._weights = weights, self._pool.take(weights.shape)
            self._staging.upload(weights, self._weights[1])
        return self._weights[1]
