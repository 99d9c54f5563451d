"""A recording in which a textured plate, fixed to the camera, covers a fifth of every image, like a robot's arm."""

from dataclasses import replace

import numpy as np

SHARE = 0.2
"""Share of the rows that the plate covers."""


class Plated:
    """A sequence with the plate at the lower edge of its images; ``region`` (H, W) are its pixels."""

    def __init__(self, sequence, seed=0, distance=0.35):
        self.name, self.camera, self.calibration = sequence.name, sequence.camera, None
        self.timestamps, self.ground_truth = sequence.timestamps, sequence.ground_truth
        self._sequence, self.mask = sequence, sequence.mask
        self._distance = distance  # metres
        h, w = sequence.camera.shape
        self.region = np.arange(h)[:, None] * np.ones(w) >= (1 - SHARE) * h
        blocks = np.random.default_rng(seed).integers(0, 256, (-(-h // 8), -(-w // 8), 3), dtype=np.uint8)
        self._pattern = np.kron(blocks, np.ones((8, 8, 1), np.uint8))[:h, :w]

    def __len__(self):
        return len(self._sequence)

    def __getitem__(self, index):
        frame = self._sequence[index]
        noise = np.random.default_rng(index).normal(0, 0.001, frame.depth.shape).astype(np.float32)
        depth = np.where(self.region, np.float32(self._distance) + noise, frame.depth)
        return replace(frame, depth=depth, color=np.where(self.region[..., None], self._pattern, frame.color))
