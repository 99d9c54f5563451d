"""Recordings in the layout of the TUM RGB-D benchmark, written image by image."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_bytes, write_text
from dudmap.core.geometry.camera import Camera


class TumFolder:
    """Writes a folder of PNG files for every kind of image, and a list of each whose first line is a title."""

    def __init__(self, out: Path, title: str, kinds: Iterable[str]) -> None:
        self._out, self._title = out, title
        self._lines: dict[str, list[str]] = {kind: [] for kind in kinds}
        for kind in self._lines:
            (out / kind).mkdir(parents=True, exist_ok=True)

    def add(self, kind: str, timestamp: float, image: NDArray) -> str:
        """Write an image: (H, W, 3) uint8 RGB, (H, W) uint16, or (H, W) bool as 255 and 0; returns its line of the
        list."""
        import cv2

        pixels = image[..., ::-1] if image.ndim == 3 else image.astype(np.uint8) * 255 if image.dtype == bool else image
        line = f"{timestamp:.6f} {kind}/{timestamp:.6f}.png"
        write_bytes(self._out / line.split()[1], cv2.imencode(".png", pixels)[1].tobytes(), sync=False)
        self._lines[kind].append(line)
        return line

    def finish(self, camera: Camera, associations: Iterable[str] = (), more: Iterable[str] = ()) -> None:
        """Write the lists, and intrinsics.txt with ``more`` lines than those of the camera of the depth images."""
        lists = self._lines | ({"associations": list(associations)} if associations else {})
        for name, lines in lists.items():
            write_text(self._out / f"{name}.txt", "\n".join([f"# {self._title}", *lines]) + "\n")
        numbers = [*camera_lines(camera), f"depth_scale {camera.depth_scale}", *more]
        write_text(self._out / "intrinsics.txt", "\n".join(numbers) + "\n")


def camera_lines(camera: Camera) -> list[str]:
    """Lines of intrinsics.txt for a camera."""
    lines = [f"{key} {getattr(camera, key)}" for key in ("fx", "fy", "cx", "cy", "width", "height")]
    lens = zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False)
    return [*lines, *(f"{key} {value}" for key, value in lens)]


def depth_units(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.uint16]:
    """Depth in the units of a camera's images; 0 where it is too large for them."""
    units = np.rint(depth * camera.depth_scale)
    return np.where(units > 65535, 0, units).astype(np.uint16)
