"""Units of time stamps: nanoseconds, microseconds, milliseconds or seconds."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

CENTURY = (1e9, 4.1e9)
"""Seconds since 1970 of the years 2001 to 2099."""
LONGEST_STEP = 1000.0
"""Largest plausible median time between two rows, seconds."""
SLOWEST_COUNT = 10.0
"""Largest median step of stamps in seconds or of counters."""


class TimeUnit(NamedTuple):
    """Unit of time stamps: its name, and its number per second."""

    name: str
    per_second: float


SECONDS = TimeUnit("seconds", 1.0)
UNITS = (SECONDS, TimeUnit("milliseconds", 1e3), TimeUnit("microseconds", 1e6), TimeUnit("nanoseconds", 1e9))


def time_unit(stamps: ArrayLike) -> TimeUnit:
    """Unit of time stamps (N,), in any order.

    The unit that places all stamps in this century. Else the median step decides: at 1 to 1000 images a second at most
    1 s, 10^3 ms, 10^6 us or 10^9 ns.
    """
    values = np.sort(np.asarray(stamps, dtype=np.float64))
    steps = np.diff(values)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    for unit in UNITS if len(values) else ():
        low, high = (bound * unit.per_second for bound in CENTURY)
        if low <= values[0] and values[-1] < high and step <= LONGEST_STEP * unit.per_second:
            return unit
    if step <= SLOWEST_COUNT:
        return SECONDS
    return next((unit for unit in UNITS[1:] if step <= unit.per_second), UNITS[-1])
