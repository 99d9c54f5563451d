"""Exceptions of dudmap, with one common base class.

A message is one sentence that states what was found, what was expected and how to correct it.
"""

LARGEST_MESSAGE = 2000
"""Characters of a message; a damaged file may hold one line of a hundred megabytes, which messages quote."""


def printable(text: object) -> str:
    """A text as one line that shows what it says, for terminals, pages and files in UTF-8.

    Characters that are not printable, such as a line break, a terminal's escape sequence, another direction of writing
    or a byte that is no UTF-8 in the name of a file, are written as escapes.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


class DudmapError(Exception):
    """Base class of all errors of dudmap; the command line prints them without a traceback.

    A message is made ``printable``.
    """

    def __init__(self, message: object = "") -> None:
        text = str(message)
        if len(text) > LARGEST_MESSAGE:
            text = f"{text[: LARGEST_MESSAGE // 2]} ... {text[-LARGEST_MESSAGE // 2 :]}"
        super().__init__(printable(text))


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


class MissingExtraError(ConfigError):
    """A library of an extra is not installed; the sentence names the extra."""


class CameraError(DudmapError):
    """A camera or its driver is missing, or the camera stopped to deliver frames."""


class DeviceError(DudmapError):
    """A GPU has failed or is full; it is not used again in this process."""


class InternalError(DudmapError):
    """A defect of dudmap itself: something happened that it does not foresee, and a report of it was written."""


class MapError(DudmapError):
    """A map or mesh is invalid, or cannot be loaded or saved."""


class StateError(DudmapError):
    """The stored state of a run is missing, damaged or of another version, or the run cannot be continued."""
