"""Draw the moving picture of the README: a recording with people, and the same images without them.

python docs/moving_picture.py        # writes docs/images/people.webp

The recording is rendered (``dudmap synth``), mapped in two passes, and cleaned (``dudmap clean``). Nothing but the
images, their depth and the intrinsics is used.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dudmap import Camera, Config
from dudmap.app.pipeline.run import run
from dudmap.app.views.cleaning import Cleaner
from dudmap.io.exporting.run_content import RunContent
from dudmap.lab import synthetic

TARGET = Path(__file__).parent / "images" / "people.webp"
CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
FRAMES, EVERY = 120, 4
"""Frames of the recording (30 a second), and which of them are shown."""
GAP = 8
"""Width of the line between the two images, pixels."""


def main() -> None:
    """Write the picture to the file that is named, by default the README's."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    sequence = synthetic.sequence("room", movers=("people",), frames=FRAMES, camera=CAMERA, noise="kinect", seed=0)
    with tempfile.TemporaryDirectory() as folder:
        run(sequence, Config(), folder, passes=2, save_masks=True, ahead=0)
        cleaner = Cleaner(RunContent.load(folder), sequence)
        pairs = []
        for index in cleaner.indices[::EVERY]:
            cleaned = cleaner.clean(index)
            pairs.append(side_by_side(cleaned.frame.color, cleaned.color))
    first, *others = [Image.fromarray(pair) for pair in pairs]
    first.save(target, save_all=True, append_images=others, duration=EVERY * 1000 // 30, loop=0, quality=40, method=6)
    print(f"{target}: {len(pairs)} images, {target.stat().st_size / 1e6:.2f} MB")


def side_by_side(with_people: NDArray[np.uint8], without: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Both images (H, W, 3) with a white line between them and their captions."""
    line = np.full((len(with_people), GAP, 3), 255, dtype=np.uint8)
    return np.hstack([captioned(with_people, "recorded"), line, captioned(without, "cleaned")])


def captioned(image: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """Copy of the image with a caption at the lower left."""
    out = np.ascontiguousarray(image)
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(out, caption, (8, len(out) - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness, cv2.LINE_AA)
    return out


if __name__ == "__main__":
    main()
