"""Depth of 16-bit millimetres rotated left by three bits, as in SUN3D (Xiao et al. 2013), SUN RGB-D and the Amazon
Picking Challenge.

``(mm << 3) | (mm >> 13)``: eighths of a millimetre up to 8.19 m, small numbers beyond. Values in units of 1/8 mm are
read the same.
"""

from collections.abc import Callable
from contextlib import suppress
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import FrameError

UNITS_PER_METRE = 8000.0
LEAST_READINGS, LEAST_VALUES = 1000, 32
"""Fewest measurements, and different values, for a decision."""
MOST = 0.95
"""Smallest share of measurements with a property."""
NEAR_SHARE = 0.8
"""Smallest share below 8.19 m, with low three bits of 0."""
FARTHEST = 10000
"""Largest distance of depth cameras for rooms, mm; low bits may also number persons. A unit is wrong if a twentieth is
beyond."""
FACTORS = (2, 3, 5, 7, 11, 13)
"""Common factors of all millimetres that mean another unit."""
PLAUSIBLE = (256, 8000)
"""Range of the median distance, mm."""
DENSE = 0.9
"""Largest share of the millimetres in a range that occur in rotated depth, because steps of a camera grow with
distance."""
SAMPLED = 5
SAID = "the depth values are multiples of 8, as are millimetres rotated left by three bits (SUN3D)"


class Rotated(Enum):
    """Whether depth images are rotated; if both may be, a file may give the unit."""

    NO = ""
    POSSIBLY = f"{SAID}; if distances come out eight times too large, give --depth-unit 0.000125"
    YES = f"{SAID}: they are read as 0.125 mm per unit; --depth-unit METRES says otherwise"


def unrotated(values: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Millimetres of rotated 16-bit values."""
    stored = values.astype(np.uint16)
    return (stored >> np.uint16(3)) | (stored << np.uint16(13))


def metres(values: NDArray[np.floating], units_per_metre: float) -> NDArray[np.float32]:
    """Depth in metres of rotated 16-bit values."""
    return unrotated(values).astype(np.float32) / np.float32(units_per_metre / 8)


def judge(count: int, read: Callable[[int], NDArray[np.floating]], units_per_metre: float, *, given: bool) -> Rotated:
    """Whether the 16-bit values of the depth images of a recording are rotated.

    Args:
        read: Returns stored values by image number, 0 = none; fractions exclude 16-bit values.
        units_per_metre: Unit if not rotated.
        given: Whether a file or the user gives it.
    """
    images = []
    for index in np.unique(np.linspace(0, count - 1, SAMPLED).astype(int)).tolist():
        with suppress(FrameError):
            image = read(index)
            images.append(image[image > 0])
            if not _has_eighths(images[-1]):
                return Rotated.NO
    values = np.concatenate([*images, np.zeros(0)])
    if len(values) < LEAST_READINGS:
        return Rotated.NO
    millimetres = unrotated(values)
    seen = np.unique(millimetres)
    divided = any(np.mean(millimetres % factor == 0) > MOST for factor in FACTORS)
    if divided or len(seen) < LEAST_VALUES or not PLAUSIBLE[0] <= np.median(millimetres) <= PLAUSIBLE[1]:
        return Rotated.NO
    if given:
        return Rotated.YES if np.isclose(units_per_metre, UNITS_PER_METRE) else Rotated.POSSIBLY
    near, far = np.percentile(millimetres, (5, 95))
    dense = np.count_nonzero((seen >= near) & (seen <= far)) / (far - near + 1)
    too_far = 1000 * np.percentile(values, 95) / units_per_metre > FARTHEST
    return Rotated.YES if too_far or dense < DENSE else Rotated.POSSIBLY


def _has_eighths(values: NDArray[np.floating]) -> bool:
    """Whether the values are multiples of 8, except for far distances."""
    if len(values) == 0:
        return True
    far = values[values % 8 != 0]
    if np.any(values != np.floor(values)) or len(far) > (1 - NEAR_SHARE) * len(values):
        return False
    return len(far) == 0 or float(np.mean(unrotated(far) < FARTHEST)) > MOST
