"""Writer of tiny recordings in TUM layout."""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 64, 48


def depth_image(index: int = 0) -> np.ndarray:
    """Slanted plane at 1 to 2 m, (H, W) uint16, 5000 units per metre."""
    return np.tile(np.linspace(5000, 10000, WIDTH), (HEIGHT, 1)).astype(np.uint16) + np.uint16(index)


def color_image(index: int = 0) -> np.ndarray:
    """Red ramp, (H, W, 3) uint8 in RGB order; the green channel holds the frame number."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[..., 0] = np.arange(WIDTH, dtype=np.uint8) * 2
    image[..., 1] = index
    return image


def write_recording(
    folder: Path,
    frames: int = 5,
    *,
    rgb_shift: float = 0.004,
    intrinsics: str | None = "fx 60\nfy 60\ncx 31.5\ncy 23.5\n",
) -> Path:
    """Write ``frames`` frames at 10 Hz, with colour ``rgb_shift`` seconds later than depth."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rgb, depth = ["# timestamp filename"], ["# timestamp filename"]
    for index in range(frames):
        stamp = 100 + 0.1 * index
        cv2.imwrite(str(folder / f"rgb/{index}.png"), color_image(index)[..., ::-1])
        cv2.imwrite(str(folder / f"depth/{index}.png"), depth_image(index))
        rgb.append(f"{stamp + rgb_shift:.6f} rgb/{index}.png")
        depth.append(f"{stamp:.6f} depth/{index}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    if intrinsics is not None:
        (folder / "intrinsics.txt").write_text(intrinsics)
    return folder


def cut(path: Path, share: float = 0.6) -> Path:
    """Truncate a file to a share of its size."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path
