"""Exceptions of dudmap. A message is one sentence: finding, expectation, remedy."""

LARGEST_MESSAGE = 2000
"""Characters of a message: messages quote damaged files."""


def printable(text: object) -> str:
    """Text as one printable line, for terminals, pages and files in UTF-8.

    Escapes line breaks, terminal sequences, changes of writing direction, bytes that are no UTF-8.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


class DudmapError(Exception):
    """Base class; the command line prints errors without a traceback. The message is made ``printable``."""

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
        kind: Key under which such frames are counted.
    """

    def __init__(self, message: str, kind: str = "unreadable") -> None:
        super().__init__(message)
        self.kind = kind


class NoImagesError(DatasetError):
    """The images or masks of a run cannot be found; the sentence names the option that keeps them."""


class MissingExtraError(ConfigError):
    """A library of an extra is not installed; the sentence names the extra."""


class CameraError(DudmapError):
    """A camera or its driver is missing, or the camera stopped to deliver frames."""


class DeviceError(DudmapError):
    """A GPU has failed or is full; it is not used again in this process."""


class InternalError(DudmapError):
    """A defect of dudmap itself; a report of it was written."""


class MapError(DudmapError):
    """A map or mesh is invalid, or cannot be loaded or saved."""


class StateError(DudmapError):
    """The stored state of a run is missing, damaged or of another version, or the run cannot be continued."""
