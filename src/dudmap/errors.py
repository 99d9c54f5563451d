"""Exceptions of dudmap, with one common base class.

A message is one sentence that states what was found, what was expected and how to correct it.
"""


class DudmapError(Exception):
    """Base class of all errors of dudmap; the command line prints them without a traceback."""


class ConfigError(DudmapError):
    """A configuration key, a configuration value or another argument is invalid."""


class DatasetError(DudmapError):
    """A recording, trajectory, mask folder or reference is missing or invalid."""


class FrameError(DatasetError):
    """One frame of a recording cannot be read or used; the other frames may be valid.

    Args:
        message: The sentence.
        kind: Key under which such frames are counted.
    """

    def __init__(self, message: str, kind: str = "unreadable") -> None:
        super().__init__(message)
        self.kind = kind


class CameraError(DudmapError):
    """A camera or its driver is missing, or the camera stopped to deliver frames."""


class MapError(DudmapError):
    """A map or mesh is invalid, or cannot be loaded or saved."""


class StateError(DudmapError):
    """The stored state of a run is missing, damaged or of another version, or the run cannot be continued."""
