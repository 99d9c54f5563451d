"""Use a segmentation network as a cue, so that people are left out of the map although they stand still."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap import Camera, FrameView, Slam, TsdfVolume, synthetic

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


class PersonCue:
    """Log odds of motion from the probability of a person; ``network`` maps a time to (H, W) in 0..1."""

    def __init__(self, network: Callable[[float], NDArray[np.float32]]) -> None:
        self.network = network

    def log_odds(self, volume: TsdfVolume, view: FrameView, T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """Log odds: positive at pixels of people, else 0."""
        rows, columns = view.labelled.depth.shape
        p = cv2.resize(self.network(view.timestamp), (columns, rows), interpolation=cv2.INTER_AREA)
        p = np.clip(np.asarray(p, np.float32), 1e-3, 1 - 1e-3)
        return np.where(p > 0.5, 2 * np.log(p / (1 - p)), np.float32(0))  # doubled, to overrule the map


if __name__ == "__main__":
    office = synthetic.sequence("room", movers=("person",), start_dynamic=True, frames=12, camera=CAMERA)
    people = {office[n].timestamp: office.mask(n).astype(np.float32) for n in range(12)}  # in place of a network
    slam = Slam(CAMERA, cues=[PersonCue(people.__getitem__)])
    for n, mask in enumerate(slam.process(frame).dynamic_mask for frame in office):
        print(f"{office[n].timestamp:.2f} s: {mask[office.mask(n)].mean():.0%} of the person is masked")
