"""Calibration of a colour camera relative to the depth camera: geometry and timing."""

import tomllib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from dudmap.atomic_file import write_text
from dudmap.core.arrays import copied
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError, printable
from dudmap.input_files import DAMAGE, describe, read_toml

PARAMETERS = (
    "translation_x", "translation_y", "translation_z", "rotation_x", "rotation_y", "rotation_z", "log_focal",
    "center_x", "center_y", "k1", "k2", "delay", "readout",
)  # fmt: skip
"""Parameters in the order of a step (13,): metres, radians, logarithm of the focal lengths, pixels of the colour
image, k1 and k2 (thesis eq. 3.88), seconds."""
NUM_PARAMETERS = len(PARAMETERS)
MAX_VIGNETTING = 2.0
"""Largest vignetting: exp(-2) is a loss of seven eighths of the light in the corners."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Pose, lens and timing of the colour camera relative to the depth image of the same frame.

    The point X of the depth camera, at the time of the depth image, is seen at ``T_color_depth exp(-tau xi) X``. xi is
    the depth camera's twist per second, its own axes; tau (s) is the difference of the time stamps + ``delay`` +
    (``depth_readout`` + ``readout``) (row / height - 1/2).

    Depth images are first rectified to their middle row (``core/frames/rolling_shutter.py``).

    Attributes:
        camera: Intrinsics of the colour camera; its ``depth_scale`` has no meaning.
        T_color_depth: (4, 4) maps points of the depth camera into the colour camera.
        delay: Time of the colour image's middle row minus the depth image's, beyond the time stamps, s.
        readout: Readout of the colour image (first to last row) minus the depth image's, s.
        sigma: (13,) standard deviations of ``PARAMETERS``, NaN if unknown.
        estimated: Names of the estimated parameters; the others are given.
        depth_readout: Readout of the depth image, s.
        depth_late: Delay of depth stamps, s. No image is stamped before it is taken, so that a positive ``delay`` of
            independent stamps means late depth stamps.
        vignetting: Log ratio of brightness, centre over corners; grows with the squared distance.
        vignetting_sigma: Its standard deviation, NaN if unknown.
        depth_readout_sigma: Standard deviation of ``depth_readout``, s.
        notes: Sentences on the estimation.
    """

    camera: Camera
    T_color_depth: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    delay: float = 0.0
    readout: float = 0.0
    sigma: NDArray[np.float64] = field(default_factory=lambda: np.full(NUM_PARAMETERS, np.nan))
    estimated: tuple[str, ...] = ()
    depth_readout: float = 0.0
    depth_late: float = 0.0
    vignetting: float = 0.0
    vignetting_sigma: float = float("nan")
    depth_readout_sigma: float = float("nan")
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        T = copied(self.T_color_depth, "motion between depth and colour camera", shape=(4, 4))
        object.__setattr__(self, "T_color_depth", T)
        object.__setattr__(self, "sigma", copied(self.sigma, "standard deviations", shape=(NUM_PARAMETERS,)))
        if T.shape != (4, 4) or not (
            np.isfinite(T).all()
            and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() <= 1e-3
            and np.linalg.det(T[:3, :3]) > 0
            and np.abs(T[3] - (0, 0, 0, 1)).max() <= 1e-8
        ):
            raise DatasetError("the motion between depth and colour camera is not a 4x4 rigid motion")
        times = {"delay": self.delay, "readout": self.readout, "depth_readout": self.depth_readout}
        times["depth_late"] = self.depth_late
        if not np.all(np.isfinite([*times.values()])):
            found = ", ".join(f"{name} {value} s" for name, value in times.items())
            raise DatasetError(f"the calibration has {found}; expected finite numbers")
        if not abs(self.vignetting) <= MAX_VIGNETTING:
            limit = f"a number from -{MAX_VIGNETTING:g} to {MAX_VIGNETTING:g}"
            raise DatasetError(f"the vignetting is {self.vignetting}; expected {limit}")

    @classmethod
    def registered(cls, camera: Camera) -> "Calibration":
        """Calibration of registered, simultaneous colour."""
        return cls(replace(camera, distortion=()))

    def is_registered(self, depth_camera: Camera) -> bool:
        """Whether both images correspond with equal brightness, apart from time stamps."""
        one, other = self.camera, depth_camera
        same = (one.fx, one.fy, one.cx, one.cy, one.shape) == (other.fx, other.fy, other.cx, other.cy, other.shape)
        plain = self.delay == 0 and self.readout == 0 and self.vignetting == 0
        return same and plain and not any(one.distortion) and bool(np.array_equal(self.T_color_depth, np.eye(4)))

    def time_sigma(self, assumed: float) -> float:
        """Standard deviation of the time between colour and depth of a pixel, seconds. Estimated: root of the variances
        of the delay and of both row times (sigma / sqrt 12); else ``assumed``."""
        if not {"delay", "depth_readout"} & set(self.estimated) or np.isnan(self.depth_readout_sigma):
            return assumed
        delay, readout = (self.sigma[PARAMETERS.index(name)] for name in ("delay", "readout"))
        return float(np.linalg.norm([delay, readout / np.sqrt(12), self.depth_readout_sigma / np.sqrt(12)]))

    def is_instant(self, offset: float) -> bool:
        """Whether colour with this time stamp (s after the depth's) was taken with the depth."""
        return self.delay + offset == 0 and self.readout == 0

    @property
    def lens(self) -> NDArray[np.float64]:
        """Coefficients (5,) k1, k2, p1, p2, k3 of the lens distortion."""
        out = np.zeros(5)
        out[: len(self.camera.distortion)] = self.camera.distortion
        return out

    def with_depth_readout(self, depth_readout: float) -> "Calibration":
        """The same colour camera with another readout of the depth camera, seconds. An estimated colour readout keeps
        its absolute row times, a given one its relative ones."""
        known = "readout" in self.estimated
        readout = self.readout + self.depth_readout - depth_readout if known else self.readout
        return replace(self, readout=readout, depth_readout=depth_readout)

    def retract(self, step: NDArray[np.float64]) -> "Calibration":
        """Calibration after a step (13,) of ``PARAMETERS``, colour axes."""
        camera, factor = self.camera, float(np.exp(step[6]))
        lens = self.lens + np.array([*step[9:11], 0.0, 0.0, 0.0])
        return replace(
            self,
            camera=replace(
                camera,
                fx=camera.fx * factor,
                fy=camera.fy * factor,
                cx=camera.cx + float(step[7]),
                cy=camera.cy + float(step[8]),
                distortion=tuple(lens.tolist()) if lens.any() else (),
            ),
            T_color_depth=se3.retract(self.T_color_depth, step[:6]),
            delay=self.delay + float(step[11]),
            readout=self.readout + float(step[12]),
        )

    def step_to(self, other: "Calibration") -> NDArray[np.float64]:
        """Step (13,) with ``self.retract(step)`` equal to ``other``."""
        R = other.T_color_depth[:3, :3] @ self.T_color_depth[:3, :3].T
        return np.array(
            [
                *(other.T_color_depth[:3, 3] - self.T_color_depth[:3, 3]),
                *se3.log_rotation(R),
                np.log(other.camera.fx / self.camera.fx),
                other.camera.cx - self.camera.cx,
                other.camera.cy - self.camera.cy,
                *(other.lens - self.lens)[:2],
                other.delay - self.delay,
                other.readout - self.readout,
            ]
        )

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by name, NaN if unknown."""
        others = {"vignetting": self.vignetting_sigma, "depth_readout": self.depth_readout_sigma}
        return dict(zip(PARAMETERS, self.sigma.tolist(), strict=True)) | others

    def tree(self) -> dict[str, Any]:
        """Nested dictionary, as in the file and in metrics.json, without NaN."""
        sigma = {name: value for name, value in self.sigmas.items() if np.isfinite(value)}
        camera = asdict(self.camera) | {"distortion": list(self.camera.distortion)}
        del camera["depth_scale"]
        return {
            "T_color_depth": self.T_color_depth.tolist(),
            "delay": self.delay,
            "readout": self.readout,
            "depth_readout": self.depth_readout,
            "depth_late": self.depth_late,
            "vignetting": self.vignetting,
            "estimated": list(self.estimated),
            "camera": camera,
            "sigma": sigma,
        }

    def save(self, path: str | Path) -> None:
        """Write a TOML file."""
        head = "Colour camera relative to the depth camera: metres, radians, pixels, seconds", *self.notes
        text = "".join(f"# {printable(line)}\n" for line in head)
        write_text(path, text + tomli_w.dumps(self.tree()))

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read a TOML file that ``save`` wrote.

        Raises:
            DatasetError: The file is missing or not TOML, or a value is missing or invalid.
        """
        try:
            tree = read_toml(path)
        except (OSError, UnicodeDecodeError) as error:
            raise DatasetError(f"cannot read the calibration {path}: {describe(error)}") from error
        except tomllib.TOMLDecodeError as error:
            raise DatasetError(f"the calibration {path} is not valid TOML: {error}") from error
        try:
            camera = tree["camera"] | {"distortion": tuple(tree["camera"].get("distortion", ()))}
            known = tree.get("sigma", {})
            return cls(
                Camera(**camera),
                np.array(tree["T_color_depth"], dtype=np.float64),
                float(tree["delay"]),
                float(tree["readout"]),
                np.array([float(known.get(name, np.nan)) for name in PARAMETERS]),
                tuple(tree.get("estimated", ())),
                float(tree.get("depth_readout", 0.0)),
                float(tree.get("depth_late", 0.0)),
                float(tree.get("vignetting", 0.0)),
                float(known.get("vignetting", np.nan)),
                float(known.get("depth_readout", np.nan)),
            )
        except KeyError as error:
            raise DatasetError(f"the calibration {path} lacks {error.args[0]}") from error
        except DAMAGE as error:
            raise DatasetError(f"cannot understand the calibration {path}: {error}") from error
