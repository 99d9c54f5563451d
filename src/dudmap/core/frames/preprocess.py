"""Preprocessing of a frame: undistortion, depth limits, hole filling, smoothing (thesis section 4.3)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dudmap.config import PreprocessConfig, SensorConfig
from dudmap.core.backends.cpu.filtering import filter_depth, intensity
from dudmap.core.backends.parameters import FilterParameters
from dudmap.core.frames.color_registration import color_projection, register_color
from dudmap.core.frames.frame import NO_COLOR, Frame
from dudmap.core.frames.ignored import IgnoredRegion
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import FrameError

HOLE_NOISE = 0.01
"""Depth difference around a small hole that is always allowed, reference depths."""
STEEPEST = 9.5
"""Tangent of the largest angle of incidence that sensors measure, 84 degrees."""
FILTER_ALPHA = 0.012
"""Range standard deviation of the bilateral filter, sigma_c = FILTER_ALPHA z^2, reference depths (thesis section 4.3:
alpha = 12, in millimetres at 1 m)."""
BORDER = 0.02
"""Share of the width by which the colour image is extended."""
TYPICAL_DEPTH = 2.0
"""Distance for the colour camera's field of view, reference depths."""
DEPTH_MIN = 1e-3
"""Smallest lower depth limit, metres."""


class Preprocessor:
    """Lens undistortion, depth limits, small-hole filling and depth-adaptive smoothing.

    The separable bilateral filter takes a sixth of the exact one's time (``docs/design-notes.md``).

    Args:
        calibration: Separate colour camera. Asynchronous colour is only scaled. Pixels outside its view are dropped.
        ignore: (H, W) bool, see ``IgnoredRegion``; no depth, colours of their border.
        sensor: Reference depth of the depth camera.
    """

    def __init__(
        self,
        camera: Camera,
        config: PreprocessConfig | None = None,
        calibration: Calibration | None = None,
        ignore: NDArray[np.bool_] | None = None,
        sensor: SensorConfig | None = None,
    ) -> None:
        self.config = config or PreprocessConfig()
        self.reference_depth = reference_depth = (sensor or SensorConfig()).reference_depth
        self.calibration = calibration
        self.camera = replace(camera, distortion=())
        self._maps = _undistortion(camera) if any(camera.distortion) else None
        self._inverse_map = _distortion(camera) if any(camera.distortion) else None
        typical = TYPICAL_DEPTH * reference_depth
        self._unseen = None if calibration is None else _unseen(self.camera, calibration, typical)
        self._ignored = None if ignore is None else IgnoredRegion.of(ignore, camera, calibration)
        self._ignored_depth = None if self._ignored is None else self.mask(self._ignored.depth)
        self._parameters = FilterParameters(
            depth_min=max(self.config.depth_min, DEPTH_MIN),
            depth_max=self.config.depth_max,
            drop_mixed=self.config.drop_mixed,
            steepest=STEEPEST / camera.fx,
            fill_holes=self.config.fill_holes,
            hole_noise=HOLE_NOISE * reference_depth,
            smooth=self.config.filter == "bilateral",
            alpha=FILTER_ALPHA / reference_depth,
            sigma_px=self.config.filter_sigma_px,
            radius=self.config.filter_radius,
        )

    def __call__(self, frame: Frame) -> Observation:
        """Preprocess a frame.

        Raises:
            FrameError: Depth or colour has the wrong size or type.
        """
        self._check(frame)
        depth = np.ascontiguousarray(frame.depth, dtype=np.float32)
        rgb = np.array(frame.rgb, order="C")  # a copy, because the caller may reuse the image
        if self._ignored is not None:
            depth = np.where(self._ignored.depth, np.float32(0), depth)
            rgb = rgb if frame.color is None else self._ignored.filled(rgb)
        if self._maps is not None:
            depth, rgb = self._undistorted(depth, rgb)
        if self._unseen is not None and frame.color is not None:
            depth = np.where(self._unseen, np.float32(0), depth)
        depth = filter_depth(depth, self._parameters)
        if self._ignored_depth is not None:  # hole filling may have filled them
            depth[self._ignored_depth] = 0
        offset = 0.0 if frame.color_timestamp is None else frame.color_timestamp - frame.timestamp
        recorded = None
        has_color = frame.color is not None
        if self.calibration is not None and has_color:
            recorded, rgb = rgb, self._colors(self.calibration, rgb, depth, offset)
        images, reference_depth = (depth, intensity(rgb), rgb, recorded), self.reference_depth
        return Observation(
            frame.timestamp, self.camera, *images, offset, has_color=has_color, ignored=self._ignored_depth,
            reference_depth=reference_depth,
        )  # fmt: skip

    def _colors(
        self, calibration: Calibration, recorded: NDArray[np.uint8], depth: NDArray[np.float32], offset: float
    ) -> NDArray[np.uint8]:
        if calibration.is_instant(offset):
            projection = color_projection(calibration, np.zeros(6), offset)
            return register_color(recorded, depth, self.camera, projection)
        if recorded.shape[:2] == depth.shape:
            return recorded
        import cv2

        return np.asarray(cv2.resize(recorded, depth.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Undistorted copy of a mask (H, W) bool of a frame.

        Raises:
            FrameError: Wrong size, or not boolean.
        """
        if not isinstance(mask, np.ndarray) or mask.shape != self.camera.shape or mask.dtype != np.bool_:
            h, w = self.camera.shape
            array = isinstance(mask, np.ndarray)
            found = f"has the shape {mask.shape} and the type {mask.dtype}" if array else f"is a {type(mask).__name__}"
            raise FrameError(f"the mask {found}; expected ({h}, {w}) bool, the size of the camera's image", "type")
        if self._maps is None:
            return mask.copy()
        import cv2

        return np.asarray(cv2.remap(mask.astype(np.uint8), *self._maps[0], cv2.INTER_NEAREST)) > 0

    def distorted(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Inverse of ``mask`` (H, W); False at ignored pixels and outside the observation."""
        if self._ignored is not None and self._ignored_depth is not None:
            mask = mask & ~self._ignored_depth
        if self._inverse_map is None:
            return mask
        import cv2

        recorded = cv2.remap(
            mask.astype(np.uint8), *self._inverse_map, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        return np.asarray(recorded) > 0

    def _check(self, frame: Frame) -> None:
        camera, color = self.camera, frame.color
        color_camera = camera if self.calibration is None else self.calibration.camera
        for name, image, expected in (("depth", frame.depth, camera), ("colour", color, color_camera)):
            if not isinstance(image, np.ndarray) and not (image is None and name == "colour"):
                raise FrameError(f"the {name} image is a {type(image).__name__}; expected a NumPy array", "type")
            shape = expected.shape if name == "depth" else (*expected.shape, 3)
            if image is not None and image.shape != shape:
                which = "camera" if self.calibration is None else f"{name} camera"
                raise FrameError(
                    f"the {which} is {expected.width}x{expected.height}, but the {name} image has the shape "
                    f"{image.shape}; expected {shape}: register and resize the images beforehand",
                    "resolution",
                )
        if frame.depth.dtype.kind != "f":
            raise FrameError(
                f"depth is {frame.depth.dtype}; expected metres as float32 (Frame.from_arrays converts uint16)", "type"
            )
        if color is not None and color.dtype != np.uint8:
            raise FrameError(NO_COLOR.format("colour", color.shape, color.dtype), "type")

    def _undistorted(
        self, depth: NDArray[np.float32], rgb: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Images without lens distortion (eq. 3.88): colour interpolated, depth nearest. A separate colour camera is
        unchanged."""
        import cv2

        assert self._maps is not None
        nearest, between = self._maps
        straight = cv2.remap(depth, *nearest, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        if self.calibration is not None:
            return np.asarray(straight, dtype=np.float32), rgb
        color = cv2.remap(rgb, *between, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(straight, dtype=np.float32), np.asarray(color, dtype=np.uint8)


def _unseen(camera: Camera, calibration: Calibration, typical: float) -> NDArray[np.bool_] | None:
    """Pixels outside the colour camera's view at a ``typical`` depth (m), or None."""
    import cv2

    points = camera.backproject(np.full(camera.shape, typical, np.float32)).reshape(-1, 3).astype(np.float64)
    T, color = calibration.T_color_depth, calibration.camera
    pixels, _ = cv2.projectPoints(points, T[:3, :3], T[:3, 3], color.K, np.array(calibration.lens))
    beyond, size = BORDER * color.width, np.array([color.width, color.height]) - 1
    unseen = np.any((pixels[:, 0] < -beyond) | (pixels[:, 0] > size + beyond), axis=1).reshape(camera.shape)
    return unseen if unseen.any() else None


def _undistortion(camera: Camera) -> tuple[tuple[NDArray, NDArray], tuple[NDArray, NDArray]]:
    """Maps of cv2.remap from undistorted to distorted: nearest, and interpolated."""
    import cv2

    coefficients = np.array(camera.distortion, dtype=np.float64)
    size = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(camera.K, coefficients, None, camera.K, size, cv2.CV_32FC1)
    nearest, _ = cv2.convertMaps(u, v, cv2.CV_16SC2, nninterpolation=True)
    whole, fraction = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return (np.asarray(nearest), np.empty(0, np.uint16)), (np.asarray(whole), np.asarray(fraction))


def _distortion(camera: Camera) -> tuple[NDArray, NDArray]:
    """Nearest-pixel map of cv2.remap from distorted to undistorted."""
    import cv2

    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    coefficients = np.array(camera.distortion, dtype=np.float64)
    straight = cv2.undistortPoints(pixels, camera.K, coefficients, P=camera.K).reshape(*camera.shape, 2)
    within = np.clip(straight, -2, max(camera.shape) + 2).astype(np.float32)  # the fixed-point map holds 16 bits
    nearest, _ = cv2.convertMaps(within[..., 0], within[..., 1], cv2.CV_16SC2, nninterpolation=True)
    return np.asarray(nearest), np.empty(0, np.uint16)
