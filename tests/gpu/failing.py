"""Warp on its CPU device, made to fail as it fails on a GPU."""

import warp as wp

LOST = "Warp CUDA error 719: unspecified launch failure"
FULL = "Failed to allocate 1048576 bytes on device 'cuda:0'"


class Device:
    """What launches, copies and allocates does so until ``breaks``; then it raises what Warp raises.

    Attributes:
        error: Sentence of the error; empty while the device works.
    """

    def __init__(self, monkeypatch):
        self.error = ""
        for owner, name in ((wp, "launch"), (wp, "empty"), (wp, "zeros"), (wp.array, "numpy")):
            monkeypatch.setattr(owner, name, self._guarded(getattr(owner, name)))

    def breaks(self, error=LOST):
        self.error = error

    def works(self):
        self.error = ""

    def _guarded(self, function):
        def call(*arguments, **named):
            if self.error:
                raise RuntimeError(self.error)
            return function(*arguments, **named)

        return call
