"""Work that is omitted from a frame without time for it."""

from enum import IntEnum


class Shed(IntEnum):
    """Omitted work; each value includes the smaller ones."""

    NOTHING = 0
    MOVERS = 1
    """No moving objects."""
    LABELS = 2
    """Labels are carried from the last frame."""
    FUSION = 3
    """No fusion."""
