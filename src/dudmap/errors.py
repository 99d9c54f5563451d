"""Every error a user can cause or meet, under one root.

Messages say what was found, what was expected and how to mend it, in one sentence.
"""


class DudmapError(Exception):
    """Root of all errors that dudmap raises on purpose; the command line prints them without a traceback."""


class ConfigError(DudmapError):
    """A configuration key or value is not acceptable."""


class DatasetError(DudmapError):
    """A recording, trajectory, mask folder or reference cannot be used."""


class FrameError(DatasetError):
    """One frame of a recording cannot be read; the frames around it can."""


class MapError(DudmapError):
    """A map or mesh cannot be built, loaded or used."""


class DeviceError(DudmapError):
    """The requested compute device is not available."""
