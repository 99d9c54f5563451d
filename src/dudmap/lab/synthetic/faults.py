"""Faults of real RGB-D sensors for rendered recordings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError
from dudmap.lab.data import find

BAND_ROWS, MOST_BANDS = 16, 24
"""Rows per rolling-shutter band (least), and bands (most). A row's time errs by 1/30 of the readout at 240 rows, 1/48
from 384."""


def _fault(usual: Any, low: float, high: float) -> Any:  # noqa: ANN401 - a number or a tuple of numbers
    return field(default=usual, metadata={"limits": (low, high)})


@dataclass(frozen=True)
class SensorFaults:
    """Errors of a real sensor that its files do not state; none by default.

        Depth is taken by the recording's camera at the time stamp. Colour is taken by a separate camera with the same
        image size. The files present it as registered to the depth and taken at the same time.

    Attributes:
        color_translation: Colour camera in the depth camera's frame, metres.
        color_rotation_deg: Its rotation vector, degrees.
        color_focal_ratio: Focal lengths, colour over depth.
        color_center_shift: Principal point, colour minus depth (u, v), pixels.
        color_delay: Stamp to exposure of the middle row, seconds.
        color_readout: First to last row, seconds: row v of H is exposed at stamp + color_delay + color_readout ((v +
            1/2) / H - 1/2).
        color_distortion: k1, k2, p1, p2 left in the colour image (Brown-Conrady, thesis eq. 3.88).
        auto_exposure: Time constant, seconds, of an exposure that follows brightness; 0 for a fixed one.
        white_balance_drift: Relative amplitude of red against blue.
        vignetting: Brightness lost in the corners, in addition to every recording's.
        jpeg_quality: 1 to 100; 0 for none.
        depth_scale_error: Relative error of all depths.
        depth_offset: Added to all depths, metres.
        depth_bands: Root mean square depth error at 1 m of vertical disparity bands, metres; grows with z^2.
        depth_distortion: Root mean square relative depth error at 2 m of a smooth pattern; grows with z.
        flying_pixels: Share of edge pixels between both surfaces.
        dropped_frames: Share of missing frames.
        late_frames: Share taken late, by 10 to 60 % of the interval, with correct stamps.

    Raises:
        ConfigError: A value outside ``LIMITS`` or of wrong length.
    """

    color_translation: tuple[float, float, float] = _fault((0.0, 0.0, 0.0), -1.0, 1.0)
    color_rotation_deg: tuple[float, float, float] = _fault((0.0, 0.0, 0.0), -30.0, 30.0)
    color_focal_ratio: float = _fault(1.0, 0.3, 3.0)
    color_center_shift: tuple[float, float] = _fault((0.0, 0.0), -500.0, 500.0)
    color_delay: float = _fault(0.0, -1.0, 1.0)
    color_readout: float = _fault(0.0, -0.2, 0.2)
    color_distortion: tuple[float, float, float, float] = _fault((0.0, 0.0, 0.0, 0.0), -1.0, 1.0)
    auto_exposure: float = _fault(0.0, 0.0, 10.0)
    white_balance_drift: float = _fault(0.0, 0.0, 0.5)
    vignetting: float = _fault(0.0, 0.0, 0.9)
    jpeg_quality: float = _fault(0.0, 0.0, 100.0)
    depth_scale_error: float = _fault(0.0, -0.2, 0.2)
    depth_offset: float = _fault(0.0, -0.2, 0.2)
    depth_bands: float = _fault(0.0, 0.0, 0.02)
    depth_distortion: float = _fault(0.0, 0.0, 0.1)
    flying_pixels: float = _fault(0.0, 0.0, 1.0)
    dropped_frames: float = _fault(0.0, 0.0, 0.8)
    late_frames: float = _fault(0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for fault in fields(self):
            value, usual = getattr(self, fault.name), fault.default
            low, high = LIMITS[fault.name]
            size = len(usual) if isinstance(usual, tuple) else 1
            if np.size(value) != size or not np.all((np.asarray(value) >= low) & (np.asarray(value) <= high)):
                what = "a number" if size == 1 else f"{size} numbers"
                raise ConfigError(f"fault {fault.name} is {value}; expected {what} from {low:g} to {high:g}")

    @property
    def T_depth_color(self) -> NDArray[np.float64]:
        """(4, 4) pose of the colour camera in the depth camera's frame."""
        T = np.eye(4)
        T[:3, :3] = se3.exp_rotation(np.radians(self.color_rotation_deg))
        T[:3, 3] = self.color_translation
        return T

    def color_camera(self, camera: Camera) -> Camera:
        """Intrinsics of the colour camera beside ``camera``."""
        return replace(
            camera,
            fx=camera.fx * self.color_focal_ratio,
            fy=camera.fy * self.color_focal_ratio,
            cx=camera.cx + self.color_center_shift[0],
            cy=camera.cy + self.color_center_shift[1],
            distortion=self.color_distortion if any(self.color_distortion) else (),
        )

    @property
    def color_is_separate(self) -> bool:
        """Whether the pose, time or lens of colour differs from depth."""
        without: Any = SensorFaults()
        names = [fault.name for fault in fields(self) if fault.name.startswith("color_")]
        return any(np.any(np.not_equal(getattr(self, name), getattr(without, name))) for name in names)

    def row_bands(self, height: int, margin: int = 0, step: float = 0.0) -> list[tuple[int, int, float]]:
        """Bands rendered at one time: first row, row after the last, time relative to the stamp, s.

        ``margin`` rows are added above and below; rows count from the image edge. Times differ by at least ``step``
        seconds.
        """
        count = max(min(MOST_BANDS, height // BAND_ROWS), 1) if self.color_readout else 1
        if step > 0:
            count = min(count, max(int(np.ceil(abs(self.color_readout) / step)), 1))
        rows = np.arange(-margin, height + margin)
        times = self.color_delay + self.color_readout * ((rows + 0.5) / height - 0.5)
        edges = np.linspace(0, len(times), count + 1).astype(int)
        return [(int(a), int(b), float(times[a:b].mean())) for a, b in pairwise(edges)]

    def frame_times(self, frames: int, fps: float, seed: int) -> NDArray[np.float64]:
        """Stamps (N,) in seconds of the arriving frames; the first always arrives, at 0."""
        times = np.arange(frames) / fps
        if not self.dropped_frames and not self.late_frames:
            return np.round(times, 6)
        rng = np.random.default_rng([seed, 5])
        late = rng.random(frames) < self.late_frames
        times += late * rng.uniform(0.1, 0.6, frames) / fps
        arrives = rng.random(frames) >= self.dropped_frames
        times[0], arrives[0] = 0.0, True
        return np.round(times[arrives], 6)

    def truth(self, camera: Camera) -> dict[str, Any]:
        """Ground truth for the folder: faults, and colour camera."""
        return {
            "faults": asdict(self),
            "depth_camera": asdict(camera),
            "color_camera": asdict(self.color_camera(camera)),
            "T_depth_color": self.T_depth_color.tolist(),
        }


LIMITS: dict[str, tuple[float, float]] = {fault.name: fault.metadata["limits"] for fault in fields(SensorFaults)}
"""Smallest and largest value of every fault."""


def parse_faults(assignments: Sequence[str]) -> dict[str, Any]:
    """Faults by name from ``NAME=VALUE``, with comma-separated numbers.

    Raises:
        ConfigError: A pair cannot be understood.
    """
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        name = name.strip()
        find(name, LIMITS, "fault")
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            raise ConfigError(f"cannot understand the fault {assignment!r}; expected NAME=NUMBER[,NUMBER...]") from None
        several = isinstance(getattr(SensorFaults(), name), tuple) or len(numbers) > 1
        values[name] = numbers if several else next(iter(numbers))
    return values
