"""The ``.r3d`` files of the iPhone application Record3D: a ZIP archive of JPEG colour and LZFSE depth."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.errors import DatasetError, FrameError
from dudmap.extras import extra
from dudmap.frames.frame import Frame
from dudmap.geometry.calibration import Calibration
from dudmap.geometry.camera import Camera
from dudmap.sequences import images, intrinsics


class Record3DRecording:
    """Recording in a ``.r3d`` file.

    The depth (256x192 of a LiDAR, 640x480 of the front camera) is smaller than the colour and seen from the same
    place, so that the depth camera is the colour camera resized, and ``calibration`` holds the colour camera. The poses
    in the file are estimates of ARKit and therefore no ground truth.

    Args:
        path: The file.
        camera: Intrinsics of the depth images that replace those of the file.

    Raises:
        DatasetError: The file is damaged or lacks its metadata, or the package lzfse is missing.
    """

    format = "Record3D .r3d"
    options: tuple[str, ...] = ()

    def __init__(self, path: str | Path, camera: Camera | str | None = None) -> None:
        self.path = Path(path)
        self.name = self.path.stem
        self.ground_truth = None
        self._lzfse = _lzfse(self.path)
        try:
            self._zip = zipfile.ZipFile(self.path)
        except zipfile.BadZipFile as error:
            raise DatasetError(f"{self.path} is not a whole .r3d file: {error}") from None
        self._numbers = sorted(
            int(Path(member).stem) for member in self._zip.namelist()
            if member.startswith("rgbd/") and member.endswith(".depth") and Path(member).stem.isdigit()
        )  # fmt: skip
        if not self._numbers:
            raise DatasetError(f"{self.path} holds no depth images rgbd/N.depth")
        color, size, times = self._metadata()
        self.timestamps = times
        known = intrinsics.given(camera) if camera else None
        self.intrinsics_source = known.source if known else "the metadata of the file"
        self.camera = known.camera(*size) if known else color.resized(*size)
        calibration = Calibration(color)
        self.calibration = None if calibration.is_registered(self.camera) else calibration

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether a file is named ``*.r3d``."""
        return path.suffix.lower() == ".r3d" and path.is_file()

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> Frame:
        """Frame number ``index``.

        Raises:
            FrameError: An image is missing or damaged.
        """
        index = range(len(self))[index]
        number = self._numbers[index]
        color = images.decode_color(self._member(f"rgbd/{number}.jpg"), f"rgbd/{number}.jpg of {self.path}")
        return Frame(float(self.timestamps[index]), self._depth(number), color)

    def mask(self, index: int) -> None:
        """No true masks are known."""

    def _depth(self, number: int) -> NDArray[np.float32]:
        name = f"rgbd/{number}.depth of {self.path}"
        packed = self._member(f"rgbd/{number}.depth")
        try:
            data = self._lzfse.decompress(packed)
        except self._lzfse.error as error:
            raise FrameError(f"{name} cannot be decompressed: {error}") from error
        if len(data) != 4 * self.camera.width * self.camera.height:
            raise FrameError(f"{name} has {len(data)} bytes; expected {self.camera.width}x{self.camera.height} floats")
        return images.metres(np.frombuffer(data, "<f4").reshape(self.camera.shape), 1.0, name)

    def _member(self, name: str) -> bytes:
        try:
            return self._zip.read(name)
        except (KeyError, zipfile.BadZipFile, EOFError, OSError) as error:
            raise FrameError(f"cannot read {name} in {self.path}: {error}") from None

    def _metadata(self) -> tuple[Camera, tuple[int, int], NDArray[np.float64]]:
        """Colour camera, size of the depth images, and times (N,) in seconds of the frames."""
        try:
            tree: dict[str, Any] = json.loads(self._zip.read("metadata"))
            fx, _, _, _, fy, _, cx, cy, _ = (float(number) for number in tree["K"])  # column by column
            color = Camera(fx, fy, cx, cy, int(tree["w"]), int(tree["h"]))
            size = int(tree["dw"]), int(tree["dh"])
            stamps = tree.get("frameTimestamps") or [n / float(tree["fps"]) for n in range(max(self._numbers) + 1)]
            times = np.array([stamps[number] for number in self._numbers], dtype=np.float64)
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise DatasetError(f"cannot understand the metadata of {self.path}: {error!r}") from None
        if np.any(np.diff(times) <= 0):
            raise DatasetError(f"the frame times in the metadata of {self.path} do not increase")
        return color, size, times


def _lzfse(path: Path) -> Any:  # noqa: ANN401 - an optional package
    with extra("record3d", f"the recording {path}"):
        import lzfse  # pyright: ignore[reportMissingImports]
    return lzfse
