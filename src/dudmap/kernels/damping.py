"""Rules of the Levenberg-Marquardt steps of a registration (Marquardt 1963), for the loop on the host and on a device.

Plain functions of float64 numbers: the host calls them, and Warp compiles the same text.
"""

SHORT_STEP = 4.0
"""A step shorter than this multiple of the stop tolerance also ends a level if the cost hardly changes."""
FLOOR = 1e-9
"""Share of the largest diagonal element that is always added, so that a direction without information stays still."""
FACTOR, LEAST = 5.0, 1e-6
"""The damping grows and shrinks by this factor, down to the least one."""


def added(diagonal, largest, damping):
    """What is added to an element of the diagonal of H, of which ``largest`` is the largest."""
    return damping * diagonal + FLOOR * largest


def is_settled(length, cost, trial_cost, stop, stop_gain):
    """Whether a step of a length, which changes the cost, is the last one."""
    return length < SHORT_STEP * stop and abs(trial_cost - cost) < stop_gain * cost


def relaxed(damping):
    """Damping after a step that has decreased the cost."""
    return max(damping / FACTOR, LEAST)


def tightened(damping):
    """Damping after a step that has not."""
    return damping * FACTOR
