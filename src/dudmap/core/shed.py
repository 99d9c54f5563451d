"""Work omitted from a frame without time for it."""

from enum import IntFlag


class Shed(IntFlag):
    """Omitted work."""

    NOTHING = 0
    MOVERS = 1
    """No moving objects."""
    LABELS = 2
    """The dynamic pixels of the last frame, carried over by the pose."""
    FUSION = 4
    """The frame is not fused."""
    MOST = 8
    """Labels and fusion of two of three frames, instead of every second one."""
