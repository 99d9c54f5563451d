"""Excerpt of a recording in the layout of the TUM benchmark with images of half the width and height.

``python benchmarks/half_resolution.py RECORDING OUT --start 0 --frames 80 --step 2``

Used for docs/sensitivity.md, whose hundreds of runs need short recordings. Colour is averaged over 2x2 pixels. A depth
pixel takes the second smallest of its four readings (the smallest of one), which is a reading and no mean across an
edge; a mask pixel is dynamic if one of its four is.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def halved_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """(H / 2, W / 2) depth of (H, W) depth; 0 is no reading."""
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    four = depth[: 2 * height, : 2 * width].reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    four = np.sort(np.where(four == 0, np.iinfo(np.uint16).max, four), axis=2)
    chosen = np.where(four[..., 1] < np.iinfo(np.uint16).max, four[..., 1], four[..., 0])
    return np.where(chosen < np.iinfo(np.uint16).max, chosen, 0).astype(np.uint16)


def halved_intrinsics(text: str) -> str:
    """Lines "key value" of a camera of half the width and height; pixel centres are whole numbers."""
    values = dict(line.split()[:2] for line in text.splitlines() if line.strip() and line[0] != "#")
    for key in ("fx", "fy"):
        values[key] = f"{float(values[key]) / 2:.6f}"
    for key in ("cx", "cy"):
        values[key] = f"{(float(values[key]) + 0.5) / 2 - 0.5:.6f}"
    for key in ("width", "height"):
        values[key] = str(int(float(values[key])) // 2)
    return "".join(f"{key} {value}\n" for key, value in values.items())


def excerpt(recording: Path, out: Path, start: int, frames: int, step: int, full: bool) -> int:
    """Write the excerpt and return its number of frames."""
    rows = [line.split() for line in (recording / "associations.txt").read_text().splitlines() if line[0] != "#"]
    rows = rows[start::step][:frames]
    for name in ("rgb", "depth", "mask"):
        (out / name).mkdir(parents=True, exist_ok=True)
    masks = {}
    if (recording / "mask.txt").is_file():
        lines = (recording / "mask.txt").read_text().splitlines()
        masks = {float(line.split()[0]): line.split()[1] for line in lines if line[0] != "#"}
    kept = []
    for row in rows:
        color = cv2.imread(str(recording / row[1]), cv2.IMREAD_COLOR)
        depth = cv2.imread(str(recording / row[3]), cv2.IMREAD_UNCHANGED)
        if color is None or depth is None:
            raise SystemExit(f"cannot read {row[1]} or {row[3]} of {recording}")
        color_file = f"{Path(row[1]).with_suffix('.png')}"
        size = (color.shape[1] // 2, color.shape[0] // 2)
        cv2.imwrite(str(out / color_file), color if full else cv2.resize(color, size, interpolation=cv2.INTER_AREA))
        cv2.imwrite(str(out / row[3]), depth if full else halved_depth(np.asarray(depth, np.uint16)))
        if masks:
            mask_file = masks[min(masks, key=lambda t, at=float(row[0]): abs(t - at))]
            mask = cv2.imread(str(recording / mask_file), cv2.IMREAD_GRAYSCALE)
            assert mask is not None, mask_file
            small = cv2.resize(cv2.dilate(mask, np.ones((2, 2))), size, interpolation=cv2.INTER_NEAREST)
            cv2.imwrite(str(out / mask_file), mask if full else small)
            kept.append((row[0], mask_file))
        row[1] = color_file
    write = {"rgb.txt": [row[:2] for row in rows], "depth.txt": [row[2:] for row in rows], "associations.txt": rows}
    for name, lines in (write | ({"mask.txt": kept} if kept else {})).items():
        (out / name).write_text("".join(" ".join(line) + "\n" for line in lines))
    if not kept:
        (out / "mask").rmdir()
    shutil.copy(recording / "groundtruth.txt", out / "groundtruth.txt")
    intrinsics = (recording / "intrinsics.txt").read_text()
    (out / "intrinsics.txt").write_text(intrinsics if full else halved_intrinsics(intrinsics))
    return len(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--start", type=int, default=0, help="first frame")
    parser.add_argument("--frames", type=int, default=80, help="number of frames")
    parser.add_argument("--step", type=int, default=1, help="take every so manieth frame")
    parser.add_argument("--full", action="store_true", help="keep the size of the images")
    given = parser.parse_args()
    print(excerpt(given.recording, given.out, given.start, given.frames, given.step, given.full), "frames")
