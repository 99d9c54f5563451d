"""Labels of a frame on a device: residuals, log odds, mean field and growing regions, without the host in between."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.components import Components
from dudmap.gpu.kernels import images as pixels
from dudmap.gpu.kernels import labels as kernels
from dudmap.gpu.kernels.formulas import motion_of
from dudmap.gpu.kernels.structs import camera_of, struct
from dudmap.gpu.memory import DeviceImage, Images
from dudmap.gpu.staging import Staging
from dudmap.gpu.streams import Queue
from dudmap.kernels.evidence import BINS, EvidenceParameters, NoiseParameters, ReadingNoise, ResidualCounts
from dudmap.kernels.parameters import MapSample
from dudmap.kernels.reprojection import ReprojectionTarget
from dudmap.kernels.segmentation import SegmentImage, SegmentSums

RUN = kernels.RUN
STEPS = np.array([1, 1, 1, 1, 2.0**20, 2.0**30, 2.0**30, 2.0**30])
"""Steps of each column of the sums over segments."""


class LabelOperations:
    """Operations of ``Backend`` on the label image, in the main queue; the images can no longer be written to.

    Args:
        images: Arrays of the device that the host has equals of.
        queue: The main queue.
        staging: Of that queue.
    """

    def __init__(self, images: Images, queue: Queue, staging: Staging) -> None:
        self._images, self._queue, self._staging = images, queue, staging
        self._scratch: dict[tuple[Any, ...], Any] = {}
        self._components = Components(queue, self._buffer, staging.download)

    def reading_noise(self, depth: NDArray[np.float32], parameters: NoiseParameters) -> Any:  # noqa: ANN401
        """See ``Backend.reading_noise``; the images stay on the device."""
        out = [self._empty(depth.shape) for _ in ReadingNoise._fields]
        self._queue.launch(kernels.reading_noise, depth.shape, self._up(depth), struct(parameters), *out)
        return ReadingNoise(*(DeviceImage(image, self._queue) for image in out))

    def residual_counts(
        self, sample: MapSample, depth: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> ResidualCounts:
        """See ``Backend.residual_counts``."""
        counts = wp.zeros(BINS + 2, dtype=wp.int32, device=self._queue.device)
        maps = self._up(sample.distance), self._up(sample.occupancy)
        self._queue.launch(kernels.count_residuals, depth.shape, *maps, self._up(depth), self._up(sigma), counts)
        found = self._staging.download(counts).astype(np.int64)
        return ResidualCounts(found[:BINS], float(found[BINS + 1] / max(found[BINS], 1)))

    def free_space(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        noise: NDArray[np.float32],
        targets: Sequence[ReprojectionTarget],
        side: int,
    ) -> Any:  # noqa: ANN401 - a DeviceImage stands for an array
        """See ``Backend.free_space``; the image stays on the device."""
        if not targets:
            return DeviceImage(wp.zeros(depth.shape, dtype=wp.uint8, device=self._queue.device), self._queue, np.bool_)
        shape, z, step, camera = depth.shape, self._up(depth), self._up(noise), camera_of(intrinsics)
        free, surface = (self._buffer(shape, wp.int32, use) for use in ("free", "surface"))
        for number, target in enumerate(targets):
            older = self._older(target)
            self._queue.launch(kernels.count_views, shape, z, step, camera, *older, int(number == 0), free, surface)
        eroded, out = self._buffer(shape, wp.uint8, "eroded"), self._empty(shape, wp.uint8)
        self._queue.launch(kernels.eroded_views, shape, free, surface, side // 2, eroded)
        self._queue.launch(kernels.dilated, shape, eroded, side // 2, out)
        return DeviceImage(out, self._queue, np.bool_)

    def log_odds(
        self,
        sample: MapSample,
        sigma: NDArray[np.float32],
        parameters: EvidenceParameters,
        free_space: bool,
        seen_free: NDArray[np.bool_] | None,
    ) -> Any:  # noqa: ANN401 - a DeviceImage stands for an array
        """See ``Backend.log_odds``; the image stays on the device."""
        shape = sample.occupancy.shape
        occupancy, out = self._up(sample.occupancy), self._empty(shape)
        seen = occupancy if seen_free is None else self._up(seen_free)
        self._queue.launch(
            kernels.log_odds, shape, self._up(sample.distance), occupancy, self._up(sigma), struct(parameters),
            int(free_space), int(seen_free is not None), seen, out,
        )  # fmt: skip
        return DeviceImage(out, self._queue)

    def label(
        self,
        log_odds: NDArray[np.float32],
        depth: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        coupling: float,
        sweeps: int,
    ) -> NDArray[np.float32]:
        """See ``Backend.label``."""
        shape, odds, z, step = depth.shape, self._up(log_odds), self._up(depth), self._up(tolerance)
        spin, other = (self._buffer(shape, wp.float32, use) for use in ("spin", "other spin"))
        self._queue.launch(pixels.first_spins, shape, odds, spin)
        for _ in range(sweeps):
            self._queue.launch(pixels.mean_field_sweep, shape, odds, z, step, coupling / 8, spin, other)
            spin, other = other, spin
        self._queue.launch(pixels.probabilities, shape, spin, other)
        return self._staging.download(other)

    def moving_regions(
        self,
        seeds: NDArray[np.bool_],
        log_odds: NDArray[np.float32],
        depth: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        min_area: float,
        seeded_share: float,
    ) -> NDArray[np.bool_]:
        """See ``Backend.moving_regions``."""
        images = self._up(seeds), self._up(log_odds), self._up(depth), self._up(tolerance)
        return self._components.moving_regions(*images, min_area, seeded_share)

    def seen_marked(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],  # that of the older frame is not compared
        intrinsics: NDArray[np.float32],
        target: ReprojectionTarget,
        max_gap: float,
    ) -> Any:  # noqa: ANN401 - a DeviceImage stands for an array
        """See ``Backend.seen_marked``; the image stays on the device."""
        out = self._empty(depth.shape, wp.uint8)
        self._queue.launch(
            kernels.marked_within, depth.shape, self._up(depth), camera_of(intrinsics), *self._older(target), max_gap,
            out,
        )  # fmt: skip
        return DeviceImage(out, self._queue, np.bool_)

    def segment_counts(
        self, labels: NDArray[np.int32], count: int, masks: Sequence[NDArray[np.bool_]]
    ) -> list[NDArray[np.int64]]:
        """See ``Backend.segment_counts``."""
        places, image = _places(count), self._up(labels)
        counts = wp.zeros((len(masks) + 1) * places, dtype=wp.int32, device=self._queue.device)
        runs = _runs(labels.shape)
        nothing = self._buffer((1, 1), wp.uint8, "nothing")
        self._queue.launch(kernels.count_segments, runs, image, nothing, counts, 1, 0)
        for number, mask in enumerate(masks, 1):
            self._queue.launch(kernels.count_segments, runs, image, self._up(mask), counts, 0, number * places)
        return list(self._staging.download(counts).reshape(-1, places)[:, : count + 1].astype(np.int64))

    def compare_segments(
        self,
        sample: MapSample,
        segments: SegmentImage,
        started: NDArray[np.bool_],
        dynamic: NDArray[np.bool_],
        intensity: NDArray[np.float32],
        exposure: tuple[float, float],
    ) -> tuple[NDArray[np.bool_], SegmentSums]:
        """See ``Backend.compare_segments``."""
        shape, places = segments.labels.shape, _places(segments.count)
        marks, begun = np.zeros(places, np.uint8), self._buffer((places,), wp.uint8, "started")
        marks[: len(started)] = started
        self._staging.upload(marks, begun)
        difference, occupancy, distance = (
            self._up(sample.difference), self._up(sample.occupancy), self._up(sample.distance),
        )  # fmt: skip
        moving = self._buffer(shape, wp.uint8, "moving")
        sums = self._sums(
            segments, (difference, occupancy, self._up(intensity), *exposure), (begun, self._up(dynamic)), distance,
            moving,
        )  # fmt: skip
        found, mask = self._staging.download_all([sums, moving])
        return mask.view(np.bool_), SegmentSums(*(found[: len(started)] / STEPS).T)

    def compare_with_frame(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        target: ReprojectionTarget,
        segments: SegmentImage,
        max_sigmas: float,
    ) -> SegmentSums:
        """See ``Backend.compare_with_frame``."""
        shape, shade = depth.shape, self._up(intensity)
        distance, difference = (self._buffer(shape, wp.float32, use) for use in ("gap", "difference"))
        occupancy, displaced = (self._buffer(shape, wp.uint8, use) for use in ("seen", "displaced"))
        self._queue.launch(
            kernels.compare_with_frame, shape, self._up(depth), shade, camera_of(intrinsics), *self._older(target),
            self._up(segments.sigma), max_sigmas, distance, difference, occupancy, displaced,
        )  # fmt: skip
        all_started = wp.full(_places(segments.count), 1, dtype=wp.uint8, device=self._queue.device)
        sums = self._sums(
            segments, (difference, occupancy, shade, 1.0, 0.0), (all_started, displaced), distance,
            self._buffer(shape, wp.uint8, "moving"),
        )  # fmt: skip
        return SegmentSums(*(self._staging.download(sums)[: segments.count + 1] / STEPS).T)

    def _sums(
        self,
        segments: SegmentImage,
        compared: tuple[Any, ...],
        marks: tuple[Any, Any],
        distance: Any,  # noqa: ANN401 - an array of Warp
        moving: Any,  # noqa: ANN401
    ) -> Any:  # noqa: ANN401
        """Sums over segments (places, 8) in steps.

        Args:
            segments: The segments.
            compared: Difference, occupancy, intensity, gain and offset.
            marks: Segments that have started, whose number gives that of the places, and moving pixels.
            distance: To the map.
            moving: Receives the moving pixels of segments that have started, and those in known space.
        """
        shape, numbers, occupancy = segments.labels.shape, self._up(segments.labels), compared[1]
        mean = self._buffer(shape, wp.float32, "mean")
        self._queue.launch(
            kernels.compare_with_map, shape, *compared, numbers, *marks, segments.window // 2, mean, moving
        )
        sums = wp.zeros((marks[0].size, len(SegmentSums._fields)), dtype=wp.int64, device=self._queue.device)
        images, sigma, gradient = (numbers, occupancy, moving), self._up(segments.sigma), self._up(segments.gradient)
        self._queue.launch(kernels.add_segments, _runs(shape), *images, distance, sigma, mean, gradient, sums)
        self._queue.launch(kernels.add_deviations, _runs(shape), *images, mean, sums)
        return sums

    def _older(self, target: ReprojectionTarget) -> tuple[Any, ...]:
        """Motion and images of an older frame, as the kernels take them."""
        motion = motion_of(target.T_target_camera[:3].astype(np.float32))
        return motion, self._up(target.depth), self._up(target.intensity), self._up(target.marks)

    def _up(self, image: Any) -> Any:  # noqa: ANN401
        if isinstance(image, np.ndarray):
            image.flags.writeable = False  # uploaded once
        return self._images.up(image, self._staging)

    def _empty(self, shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=dtype, device=self._queue.device)

    def _buffer(self, shape: tuple[int, ...], dtype: Any, use: Any) -> Any:  # noqa: ANN401
        """The array of the main queue for a use, which is overwritten in the order of the queue."""
        key = (*shape, dtype, use)
        if key not in self._scratch:
            self._scratch[key] = self._empty(shape, dtype)
        return self._scratch[key]


def _places(count: int) -> int:
    """Rows of an array for the numbers of segments from 0 on: few different ones, since each has buffers."""
    return max(256, 1 << count.bit_length())


def _runs(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows, and runs of pixels in a row."""
    return shape[0], -(-shape[1] // RUN)
