"""Warp on its CPU device, made to fail as it fails on a GPU."""

import warp as wp

LOST = "Warp CUDA error 719: unspecified launch failure"
FULL = "Failed to allocate 1048576 bytes on device 'cuda:0'"


class Device:
    """What launches, copies and allocates does so until ``breaks``; then it raises what Warp raises.

    Attributes:
        error: Sentence of the error; empty while the device works.
        only: Name of the kernel that alone fails; None = everything does.
    """

    def __init__(self, monkeypatch):
        self.error, self.only, self.launched = "", None, []
        for name in ("launch", "copy", "empty", "zeros", "full"):
            monkeypatch.setattr(wp, name, self._guarded(getattr(wp, name)))
        monkeypatch.setattr(wp.array, "numpy", self._guarded(wp.array.numpy))

    def breaks(self, error=LOST, only=None):
        self.error, self.only = error, only

    def works(self):
        self.error = ""

    def _guarded(self, function):
        def call(*arguments, **named):
            kernel = getattr(arguments[0], "key", None) if arguments else None
            if self.error and self.only in (None, kernel):
                raise RuntimeError(self.error)
            if isinstance(kernel, str):
                self.launched.append(kernel)
            return function(*arguments, **named)

        return call
