"""A preprocessed frame, its image pyramid, corners and exposure."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.core.backends.cpu.exposure import LARGE_GAIN
from dudmap.core.backends.cpu.filtering import halve
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.state import CACHE

CEILING_STRIDE, LEAST_SATURATED = 8, 0.05
"""Stride of the saturation limit, and quantile of saturated intensities."""
HALVING_BAND = 0.02
"""Largest depth difference of one surface in a 2x2 block, share of the depth, at least of the reference depth."""
CELLS = 40
"""Cells across the image; the strongest corner of each cell is used."""
WINDOW = 11
"""Edge of the window for matching a corner, pixels of an image 320 wide."""
FLOW_WIDTH = 320
"""Image width to which windows and flow refer."""


@dataclass(frozen=True, eq=False)
class Observation:
    """A preprocessed frame.

    Attributes:
        timestamp: Seconds, of the depth image.
        camera: Camera of all images here; without lens distortion.
        depth: (H, W) float32, metres, holes filled and smoothed, 0 = none.
        intensity: (H, W) float32, 0..1.
        rgb: (H, W, 3) uint8, registered, like ``intensity``. Asynchronous colour is registered once the camera's motion
            is known (``core/tracking/color_motion.py``).
        recorded_rgb: (h, w, 3) uint8, not registered; None if equal to ``rgb``.
        color_offset: Time stamp of colour minus depth, seconds; 0 if unknown.
        depth_readout: Removed rolling-shutter readout, seconds.
        has_color: Whether there is colour; else ``rgb`` and ``intensity`` are grey.
        ignored: (H, W) bool, pixels that never count; None for none.
        reference_depth: Reference depth of the sensor, metres.
        sources: (H, W) int32, recorded pixel of each pixel; None if unchanged.
    """

    timestamp: float
    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    recorded_rgb: NDArray[np.uint8] | None = None
    color_offset: float = 0.0
    depth_readout: float = 0.0
    has_color: bool = True
    ignored: NDArray[np.bool_] | None = None
    reference_depth: float = 1.0
    sources: NDArray[np.int32] | None = field(default=None, repr=False, metadata=CACHE)
    _recorded_halvings: list[NDArray[np.float32]] = field(default_factory=list, repr=False, metadata=CACHE)
    _halvings: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = field(
        default_factory=list, repr=False, metadata=CACHE
    )

    @cached_property
    def readings(self) -> NDArray[np.bool_]:
        """(H, W) bool, pixels with a depth."""
        return self.depth > 0

    @cached_property
    def num_readings(self) -> int:
        """Number of pixels with a depth."""
        return int(np.count_nonzero(self.readings))

    @cached_property
    def ceiling(self) -> float:
        """Smallest intensity with a saturated channel, else 1."""
        full = (self.rgb[::CEILING_STRIDE, ::CEILING_STRIDE] == 255).any(axis=2)
        if not full.any():
            return 1.0
        return float(np.quantile(self.intensity[::CEILING_STRIDE, ::CEILING_STRIDE][full], LEAST_SATURATED))

    def halved(self, times: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and intensity (H >> times, W >> times) of ``camera.scaled(times)``, halved by 2x2 blocks.

        Intensity is the mean of a block; depth the mean on its nearest surface. Cached.
        """
        halvings = self._halvings
        while len(halvings) < times:
            depth, intensity = halvings[-1] if halvings else (self.depth, self.intensity)
            halvings.append(halve(depth, intensity, HALVING_BAND, self.reference_depth))
        return halvings[times - 1] if times else (self.depth, self.intensity)

    @property
    def as_recorded(self) -> Frame:
        """Depth and recorded colour."""
        color = self.rgb if self.recorded_rgb is None else self.recorded_rgb
        color = color if self.has_color else None
        return Frame(self.timestamp, self.depth, color, self.timestamp + self.color_offset)


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the image pyramid.

    Attributes:
        depth, intensity: (h, w) m; (h, w) 0..1.
        ceiling: Smallest intensity that is saturated.
        shown: Intensities saturated neither in the image nor in the map.
    """

    camera: Camera
    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ceiling: float = 1.0
    shown: tuple[float, float] = (-np.inf, np.inf)

    @cached_property
    def num_readings(self) -> int:
        """Number of pixels with a depth."""
        return int(np.count_nonzero(self.depth))

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Intensities (h, w) in grey values from 0 to 255."""
        return np.clip(255 * self.intensity, 0, 255).astype(np.uint8)

    @cached_property
    def foreground(self) -> NDArray[np.bool_]:
        """Pixels (h, w) on the nearest surface in their corner window, which a window follows."""
        import cv2

        side = scaled_window(WINDOW, self.camera.width)
        readings = np.where(self.depth > 0, self.depth, np.float32(np.inf))
        nearest = np.asarray(cv2.erode(readings, np.ones((side, side), np.uint8)))
        return (self.depth > 0) & (nearest > np.float32(0.93) * self.depth)


def exposed_color(rgb: NDArray[np.uint8], exposure: tuple[float, float]) -> NDArray[np.uint8]:
    """Colours (H, W, 3) with gain and offset; black if only the image is saturated."""
    import cv2

    gain, offset = exposure
    curve = np.clip(gain * np.arange(256) + 255 * offset + 0.5, 0, 255).astype(np.uint8)
    out = rgb if exposure == (1.0, 0.0) else np.asarray(cv2.LUT(rgb, curve), dtype=np.uint8)
    if gain <= 1 / LARGE_GAIN:
        out[(rgb == 255).any(axis=2)] = 0
    return out


def shown_range(exposure: tuple[float, float], ceiling: float, other: float = 1.0) -> tuple[float, float]:
    """Map intensities saturated neither in the map (limit ``other``) nor in an image with this gain and offset
    (``ceiling``).

    Infinite if the exposures hardly differ.
    """
    gain, offset = exposure
    if 1 / LARGE_GAIN < gain < LARGE_GAIN:
        return -np.inf, np.inf
    return max(offset, 0.0), min(gain * ceiling + offset, other)


def saturated(
    level: Level, exposure: tuple[float, float], difference: NDArray[np.float32] | None = None
) -> NDArray[np.bool_] | None:
    """Saturated pixels (h, w) bool of the image; None if the exposures hardly differ.

    ``difference`` (map minus image): includes pixels saturated in the map.
    """
    darkest, brightest = shown_range(exposure, level.ceiling)
    if brightest == np.inf:
        return None
    out = (level.intensity <= 0) | (level.intensity >= level.ceiling)
    if difference is not None:
        of_map = difference + level.intensity
        out |= (of_map <= darkest) | (of_map >= brightest)
    return out


def unsaturated(level: Level, exposure: tuple[float, float]) -> Level:
    """Level with gain and offset; NaN if only the image is saturated."""
    lit, dark = exposed(level, exposure), saturated(level, exposure)
    return lit if dark is None else replace(lit, intensity=np.where(dark, np.float32(np.nan), lit.intensity))


def exposed(level: Level, exposure: tuple[float, float]) -> Level:
    """Level with gain and offset applied to its intensities."""
    gain, offset = exposure
    if (gain, offset) == (1.0, 0.0):
        return level
    intensity = np.float32(gain) * level.intensity + np.float32(offset)
    return Level(level.camera, level.depth, intensity, level.ceiling, shown_range(exposure, level.ceiling))


def chained(first: tuple[float, float], then: tuple[float, float]) -> tuple[float, float]:
    """Gain and offset of two exposures applied one after the other."""
    return then[0] * first[0], then[0] * first[1] + then[1]


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Image pyramid: levels of the registration, coarse to fine, and of the labels; each is halved several times."""

    tracked: list[Level]
    labelled: Level

    @classmethod
    def of(cls, observation: Observation, camera: Camera, config: Config) -> "Pyramid":
        """The levels with widths nearest to the configured ones."""
        widths = *config.tracker.widths, config.dynamics.width
        halvings = [max(0, round(np.log2(camera.width / width))) for width in widths]
        levels = {
            n: Level(camera.scaled(n), *observation.halved(n), observation.ceiling) for n in sorted(set(halvings))
        }
        *tracked, labelled = (levels[n] for n in halvings)
        return cls(tracked, labelled)

    @property
    def coarse(self) -> Level:
        """Coarsest level of the registration."""
        return self.tracked[0]

    @property
    def fine(self) -> Level:
        """Finest level of the registration."""
        return self.tracked[-1]

    @cached_property
    def corners(self) -> NDArray[np.int64]:
        """Corners (n, 2) int of the finest level, pixels u, v."""
        return _corners(self.fine)

    @cached_property
    def corner_points(self) -> NDArray[np.float64]:
        """Points (n, 3) at the corners, metres, camera frame."""
        (u, v), level = self.corners.T, self.fine
        return level.camera.points(u, v, level.depth[v, u].astype(np.float64))


def reduced(mask: NDArray[np.bool_], level: Level) -> NDArray[np.bool_]:
    """Mask (H, W) at the size of a level; set if any part is."""
    import cv2

    size = level.depth.shape[::-1]
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0


def is_majority_dynamic(moving: NDArray[np.bool_], level: Level) -> bool:
    """Whether more than half of the depth pixels are marked (h, w) bool."""
    return bool(2 * np.count_nonzero(moving) > level.num_readings)


def scaled_window(edge: int, width: int, reference_width: int = FLOW_WIDTH) -> int:
    """Odd window edge that covers the same view as ``edge`` at ``reference_width``."""
    return 2 * round((edge - 1) / 2 * width / reference_width) + 1


def _corners(level: Level) -> NDArray[np.int64]:
    """Strongest corner per cell, pixels u, v, on the foreground of its window (Shi and Tomasi 1994)."""
    import cv2

    image = level.grey
    strength = cv2.cornerMinEigenVal(image, 5)
    cell = max(1, image.shape[1] // CELLS)
    height, width = image.shape[0] // cell, image.shape[1] // cell
    tiles = strength[: height * cell, : width * cell].reshape(height, cell, width, cell).swapaxes(1, 2)
    tiles = tiles.reshape(height * width, cell * cell)
    strongest = tiles.argmax(axis=1)
    rows = np.arange(height * width) // width * cell + strongest // cell
    columns = np.arange(height * width) % width * cell + strongest % cell
    useful = (tiles.max(axis=1) > 1e-4) & level.foreground[rows, columns]
    return np.stack([columns, rows], axis=1)[useful]
