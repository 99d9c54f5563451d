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
        for owner, name in ((wp.array, "numpy"), (wp.Launch, "launch")):
            monkeypatch.setattr(owner, name, self._guarded(getattr(owner, name)))

    def breaks(self, error=LOST, only=None):
        self.error, self.only = error, only

    def works(self):
        self.error = ""

    def _guarded(self, function):
        def call(*arguments, **named):
            first = arguments[0] if arguments else None
            kernel = getattr(getattr(first, "kernel", first), "key", None)  # of a recorded launch, or of a kernel
            if self.error and self.only in (None, kernel):
                raise RuntimeError(self.error)
            if isinstance(kernel, str):
                self.launched.append(kernel)
            return function(*arguments, **named)

        return call
