"""Images kept in the run folder, as a recording in TUM layout."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.observer import RunObserver
from dudmap.atomic_file import write_bytes, write_image, write_text
from dudmap.core.geometry import se3
from dudmap.errors import FrameError
from dudmap.own_folder import make_folder

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam
    from dudmap.io.cameras import LiveCamera
    from dudmap.io.sequences import Sequence

FOLDER = "images"
APART, APART_DEG, SECONDS = 0.025, 1.5, 0.3
"""Motion (metres, degrees) and time after which a frame is kept: half a texture's step between views."""
JPEG_QUALITY = 95


class ImageKeeper(RunObserver):
    """Keeps colour (JPEG) and depth (PNG) of tracked frames when the camera has moved.

    Args:
        source: Recording or camera; None continues an interrupted run.
    """

    in_background = True

    def __init__(self, source: "Sequence | LiveCamera | None") -> None:
        self._source = source
        self._last: tuple[float, NDArray[np.float64]] | None = None

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Make the folder, and describe the cameras."""
        from dudmap.app.views.rendering import camera_lines

        self._folder, self._last = out / FOLDER, None
        self._camera = slam.camera if self._source is None else self._source.camera
        if self._source is None:
            return
        make_folder(self._folder)
        camera, calibration = self._source.camera, self._source.calibration
        lines = [*camera_lines(camera), f"depth_scale {camera.depth_scale}"]
        if calibration is not None:
            T = se3.inverse(calibration.T_color_depth)
            lines += [f"color_{line}" for line in camera_lines(calibration.camera)]
            lines.append("T_depth_color " + " ".join(f"{value:.9g}" for value in T.reshape(-1)))
        write_text(self._folder / "intrinsics.txt", "\n".join(lines) + "\n")

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Keep a frame with colour and pose, if the camera has moved."""
        import cv2

        from dudmap.app.views.rendering import depth_units

        frame, T = read.frame, result.T_world_camera
        if isinstance(frame, FrameError) or frame.color is None or T is None or result.status != "tracked":
            return
        if self._last is not None and 0 <= frame.timestamp - self._last[0] < SECONDS:
            if se3.agree(self._last[1], T, APART, APART_DEG):
                return
        self._last = frame.timestamp, T
        color_time = frame.timestamp if frame.color_timestamp is None else frame.color_timestamp
        color, depth = f"{color_time:.6f}.jpg", f"{frame.timestamp:.6f}.png"
        if (self._folder / depth).exists():  # of an earlier pass, or before an interruption
            return
        jpeg = cv2.imencode(".jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        write_bytes(self._folder / color, jpeg.tobytes(), sync=False, own=True)
        write_image(self._folder / depth, depth_units(frame.depth, self._camera), sync=False, own=True)
        with (self._folder / "associations.txt").open("a", encoding="utf-8") as file:
            file.write(f"{color_time:.6f} {color} {frame.timestamp:.6f} {depth}\n")
