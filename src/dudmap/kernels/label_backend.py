"""The operations on the label image that the system asks of a compute device; see ``backend.py``."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dudmap.kernels.evidence import EvidenceParameters, NoiseParameters, ReadingNoise, ResidualCounts
from dudmap.kernels.parameters import MapSample
from dudmap.kernels.reprojection import ReprojectionTarget
from dudmap.kernels.segmentation import SegmentImage, SegmentSums


class LabelBackend(Protocol):
    """Operations on images at the resolution of the labels.

    Images that these give may be anything that ``np.asarray`` takes, so that a device keeps what nobody reads.
    """

    def reading_noise(self, depth: NDArray[np.float32], parameters: NoiseParameters) -> ReadingNoise:
        """Noise of the readings of an image (h, w), metres, 0 = none."""
        ...

    def residual_counts(
        self, sample: MapSample, depth: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> ResidualCounts:
        """Histogram of the normalised residuals of an image at the surfaces of the map; arguments as of ``log_odds``,
        and the depth (h, w) in metres, 0 = none."""
        ...

    def free_space(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        noise: NDArray[np.float32],
        targets: Sequence[ReprojectionTarget],
        side: int,
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) bool that at least half as many older frames have seen through as have a reading there, opened.

        Args:
            depth, intensity: (h, w) float32; depth in metres, 0 = none.
            intrinsics: (4,) float32 fx, fy, cx, cy.
            noise: (h, w) float32, largest depth difference of two readings of one point, metres.
            targets: The older frames.
            side: Of the square that the mask is opened with, pixels, odd.
        """
        ...

    def log_odds(
        self,
        sample: MapSample,
        sigma: NDArray[np.float32],
        parameters: EvidenceParameters,
        free_space: bool,
        seen_free: NDArray[np.bool_] | None,
    ) -> NDArray[np.float32]:
        """Log odds static : dynamic (h, w) float32 of each pixel alone, 0 = unknown (eq. 4.56, 4.57).

        Args:
            sample: The map at the points of the image.
            sigma: (h, w) float32, standard deviation of the distance of a static point, metres.
            parameters: Of the log odds at surfaces of the map.
            free_space: Whether a pixel in space that the map knows to be free is certain to move.
            seen_free: (h, w) bool, other pixels that then are, as of ``free_space``; None = none.
        """
        ...

    def label(
        self,
        log_odds: NDArray[np.float32],
        depth: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        coupling: float,
        sweeps: int,
    ) -> NDArray[np.float32]:
        """Static probability (h, w) of each pixel, consistent with its neighbours on the same surface (algorithm 3).

        Args:
            log_odds: (h, w) float32 log odds static : dynamic of each pixel alone; 0 = unknown.
            depth: (h, w) float32, metres, 0 = none.
            tolerance: (h, w) float32, largest depth step to a neighbour of the same surface, metres.
            coupling: Log odds that all neighbours together can add.
            sweeps: Iterations of the mean field.
        """
        ...

    def moving_regions(
        self,
        seeds: NDArray[np.bool_],
        log_odds: NDArray[np.float32],
        depth: NDArray[np.float32],
        tolerance: NDArray[np.float32],
        min_area: float,
        seeded_share: float,
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) bool of regions that grow from seeds over the surface, up to depth edges and static pixels.

        Args:
            seeds: (h, w) bool, pixels with a reading.
            log_odds: As of ``label``; a pixel is static from 1 on.
            depth, tolerance: As of ``label``.
            min_area: Fewest pixels of a region.
            seeded_share: Least share of seeds in a region.
        """
        ...

    def seen_marked(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        target: ReprojectionTarget,
        max_gap: float,
    ) -> NDArray[np.bool_]:
        """Pixels (h, w) bool whose points a marked reading of an older frame shows, within ``max_gap`` metres.

        Args:
            depth, intensity: (h, w) float32; depth in metres, 0 = none.
            intrinsics: (4,) float32 fx, fy, cx, cy.
            target: The older frame.
            max_gap: Metres.
        """
        ...

    def segment_counts(
        self, labels: NDArray[np.int32], count: int, masks: Sequence[NDArray[np.bool_]]
    ) -> list[NDArray[np.int64]]:
        """Pixels (count + 1,) of each segment, and for each mask (h, w) those that lie in it.

        Args:
            labels: (h, w) int32 numbers of the segments from 1, 0 = none.
            count: Number of segments.
            masks: Any number.
        """
        ...

    def compare_segments(
        self,
        sample: MapSample,
        segments: SegmentImage,
        started: NDArray[np.bool_],
        dynamic: NDArray[np.bool_],
        intensity: NDArray[np.float32],
        exposure: tuple[float, float],
    ) -> tuple[NDArray[np.bool_], SegmentSums]:
        """Dynamic pixels (h, w) bool, without those in unknown space whose segment has not started to move, and sums
        over the segments, of a frame compared with the map.

        Args:
            sample: The map at the points of the image.
            segments: The segments of the image.
            started: (count + 1,) bool, segments that have started.
            dynamic: (h, w) bool.
            intensity: (h, w) float32.
            exposure: Gain and offset that make the image's intensities those of the map.
        """
        ...

    def compare_with_frame(
        self,
        depth: NDArray[np.float32],
        intensity: NDArray[np.float32],
        intrinsics: NDArray[np.float32],
        target: ReprojectionTarget,
        segments: SegmentImage,
        max_sigmas: float,
    ) -> SegmentSums:
        """Sums over the segments of a frame compared with an older one, in which points move that are off by more than
        ``max_sigmas``; other arguments as of ``seen_marked`` and ``compare_segments``."""
        ...
