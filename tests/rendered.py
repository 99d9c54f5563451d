"""A synthetic sequence whose frames and masks are rendered once, for tests that go through it more than once."""

from functools import cache


class Rendered:
    """The frames of a sequence, rendered when they are first asked for and kept."""

    def __init__(self, sequence):
        self.name, self.camera, self.calibration = sequence.name, sequence.camera, None
        self.timestamps, self.ground_truth = sequence.timestamps, sequence.ground_truth
        self._length, self._frame, self.mask = len(sequence), cache(sequence.__getitem__), cache(sequence.mask)

    def __len__(self):
        return self._length

    def __getitem__(self, index):
        return self._frame(index)
