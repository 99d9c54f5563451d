"""The thesis' system (algorithm 4)."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.config import VolumeConfig
from dudmap.core.backends.cpu.filtering import intensity
from dudmap.core.dynamics.masks import full_size
from dudmap.core.frames.color_registration import color_projection, register_color
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, Observation
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.result import FrameResult, Status
from dudmap.core.verdict import ACCEPTED, Outcome, Verdict
from dudmap.errors import FrameError
from dudmap.thesis.depth_filter import bilateral, fill_zeros
from dudmap.thesis.labels import dynamic_labels
from dudmap.thesis.lens import Lens
from dudmap.thesis.registration import Registration
from dudmap.thesis.similarity import Similarity
from dudmap.thesis_config import ThesisConfig

Result = TypeVar("Result")


def volume_config(config: ThesisConfig) -> VolumeConfig:
    """Map of algorithm 1: constant weight 1, W_max, a band fixed in metres, no other rule."""
    return VolumeConfig(
        voxel_size=config.tau, truncation_voxels=config.d_max / config.tau,
        truncation_behind_voxels=config.d_min / config.tau, truncation_noise=0.0, weighting="constant",
        max_weight=config.w_max, max_readings=config.w_max, take_turns=False, carve_rate=1,
        free_after=config.empty_after, min_weight=min(3, config.w_max),
    )  # fmt: skip


class ThesisSlam:
    """Dense SLAM of chapter 4 of the thesis; failed registrations are neither detected nor recovered.

    Args:
        calibration: Of the colour camera; None for registered colour, as in the thesis.

    Attributes:
        volume: The map.
        color_error: (h, w) float32 e_c of the last registered frame (eq. 4.49); NaN without colour in the map.
    """

    first_pass, localize, device, calibration_waits = None, False, "cpu", 0

    def __init__(
        self, camera: Camera, config: ThesisConfig | None = None, calibration: Calibration | None = None
    ) -> None:
        self.config = config = config or ThesisConfig()
        self.lens, self.camera = Lens(camera), replace(camera, distortion=())
        self.calibration = calibration or Calibration.registered(camera)
        self.volume = TsdfVolume(self.camera, volume_config(config), depth_max=config.depth_max)
        self.similarity = Similarity(config.lowe_ratio)
        self.registration = Registration(config)
        self.color_error = np.empty((0, 0), np.float32)
        self._poses: list[tuple[float, NDArray[np.float64]]] = []
        self._timings: dict[str, float] = {}

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames so far."""
        return Trajectory.from_poses(self._poses)

    @property
    def live_volume(self) -> TsdfVolume:
        """The map."""
        return self.volume

    @property
    def maps(self) -> list[tuple[Trajectory, TsdfVolume]]:
        """Trajectory and map; the system has no submaps."""
        return [(self.trajectory, self.volume)]

    def process(self, frame: Frame | Observation) -> FrameResult:
        """Register a frame, label its dynamic pixels, register it again without them, fuse the rest (algorithm 4).

        Reading: a redundant frame is neither registered nor fused, and keeps the pose of its predecessor.

        Args:
            frame: In order of arrival; ``prepare`` may have been called.

        Raises:
            FrameError: The images do not have the camera's size.
        """
        self._timings = {}
        image = self._timed("preprocess", lambda: self.prepare(frame)) if isinstance(frame, Frame) else frame
        levels = self._levels(image)
        dynamic = np.zeros(levels[0].depth.shape, bool)
        similarity = self._timed("similarity", lambda: self.similarity.ratio(image.intensity))
        if not self._poses:
            return self._fused(image, np.eye(4), dynamic, levels[0])
        T = self._poses[-1][1]
        if similarity > self.config.similarity:
            known = "the view resembles the last fused one by {figure:.0%}"
            similar = Verdict((Outcome.of("redundant", similarity, self.config.similarity, known),))
            return self._result(image, T, dynamic, levels[0], similar=similar)
        T, found = self._timed("track", lambda: self.registration.align(self.volume, levels, T))
        dynamic, _ = self._timed("label", lambda: dynamic_labels(found.psi, _points(levels[0], T), self.config))
        T, found = self._timed("track_again", lambda: self.registration.align(self.volume, levels, T, dynamic))
        self.color_error = np.abs(found.e_c)  # eq. 4.49
        return self._fused(image, T, dynamic, levels[0], found.psi)

    # -- steps of process ---------------------------------------------------------------------------------------------

    def prepare(self, frame: Frame) -> Observation:
        """The images without distortion, the depth filled and smoothed (section 4.3)."""
        config, registered = self.config, self.calibration.is_registered(self.camera)
        if frame.depth.shape != self.camera.shape or (registered and frame.rgb.shape[:2] != self.camera.shape):
            raise FrameError(
                f"the camera is {self.camera.width}x{self.camera.height}, but depth has the shape {frame.depth.shape} "
                f"and colour {frame.rgb.shape}",
                "resolution",
            )
        D = self.lens.undistort(frame.depth, nearest=True)
        D = np.where((config.depth_min <= D) & (config.depth_max >= D), D, np.float32(0))
        D = bilateral(fill_zeros(D), config.alpha / 1000, config.sigma_s, config.filter_radius)
        if registered:
            rgb = np.ascontiguousarray(self.lens.undistort(frame.rgb, nearest=False))
        else:
            rgb = register_color(frame.rgb, D, self.camera, color_projection(self.calibration, np.zeros(6), 0.0))
        return Observation(frame.timestamp, self.camera, D, intensity(rgb), rgb)

    def _levels(self, image: Observation) -> list[Level]:
        first = 1 if self.config.subsample == "quarter" else 0
        halvings = range(first, first + self.config.levels)
        return [Level(self.camera.scaled(n), *image.halved(n)) for n in halvings]

    def _fused(
        self,
        image: Observation,
        T: NDArray[np.float64],
        dynamic: NDArray[np.bool_],
        level: Level,
        psi: NDArray[np.float32] | None = None,
    ) -> FrameResult:
        static = ~full_size(dynamic, level.depth, image.depth)
        frame = Frame(image.timestamp, image.depth, image.rgb)
        self._timed("integrate", lambda: self.volume.integrate(frame, T, static))
        return self._result(image, T, dynamic, level, psi)

    def _result(
        self,
        image: Observation,
        T: NDArray[np.float64],
        dynamic: NDArray[np.bool_],
        level: Level,
        psi: NDArray[np.float32] | None = None,
        *,
        similar: Verdict = ACCEPTED,
    ) -> FrameResult:
        self._poses.append((image.timestamp, T))
        mask = full_size(dynamic, level.depth, image.depth)
        return FrameResult(
            image.timestamp, Status.TRACKED, T, None, similar, dynamic_mask=self.lens.distorted(mask),
            dynamic_share=np.count_nonzero(mask & image.readings) / max(image.num_readings, 1),
            residuals=np.full((1, 1), np.nan, np.float32) if psi is None else psi,
            timings=self._timings,
        )  # fmt: skip

    def _timed(self, stage: str, function: Callable[[], Result]) -> Result:
        start = time.perf_counter()
        out = function()
        self._timings[stage] = 1000 * (time.perf_counter() - start)
        return out


def _points(level: Level, T: NDArray[np.float64]) -> NDArray[np.float64]:
    return level.camera.backproject(level.depth).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
