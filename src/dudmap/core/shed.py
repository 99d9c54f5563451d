"""Work that is omitted from a frame if there is no time for it."""

from enum import IntEnum


class Shed(IntEnum):
    """Omitted work; each value includes the smaller ones."""

    NOTHING = 0
    MOVERS = 1
    """No moving objects."""
    LABELS = 2
    """The dynamic pixels of the last frame, carried over by the pose."""
    FUSION = 3
    """The frame is not fused."""
