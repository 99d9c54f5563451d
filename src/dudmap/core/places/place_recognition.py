"""Place recognition: keyframes with features of known 3D position, and the poses they suggest.

SIFT features (Lowe 2004) are compared as RootSIFT (Arandjelovic and Zisserman 2012). Poses come from 3D-3D RANSAC over
three pairs of points (Fischler and Bolles 1981; see ``rigid_ransac``).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.config import RelocalizationConfig, SensorConfig
from dudmap.core.backends.threads import submit
from dudmap.core.frames.observation import Observation
from dudmap.core.geometry.alignment import rigid_ransac
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import agree, difference
from dudmap.core.places.features import SiftExtractor, match_descriptors, reduced_grey
from dudmap.core.state import Remembered, Stateful
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import Outcome, Verdict

MAX_FEATURES, IMAGE_WIDTH = 400, 320
"""Features of a frame, and width of the image in which they are detected, pixels."""
RATIO = 0.85
"""Nearest over second nearest descriptor distance (Lowe 2004: 0.8)."""
MIN_INLIERS, MIN_SHARE = 15, 0.25
"""RANSAC inliers of a match, and their share among the matches."""
MIN_ON_MAP = 0.4
"""Smallest share of measurements static and on the map at an accepted pose."""
MAX_CORRECTION, MAX_CORRECTION_DEG = 0.06, 3.0
"""Largest correction of the feature pose by the registration, reference depths and degrees."""
COARSE_FEATURES = 64
"""Strongest features per keyframe that select keyframes for matching."""
MAX_MATCHED = 5
"""Fully matched keyframes per frame."""
POSITION_ERROR = 0.01
"""Largest position error of a feature beyond sensor noise, per metre of depth: 2.6 pixels at a width of 320 and 63
degrees."""
DUPLICATE_DISTANCE, DUPLICATE_ANGLE_DEG = 0.1, 5.0
"""Matches in one submap at nearer poses (reference depths, deg) are duplicates."""


@dataclass(frozen=True, eq=False)
class PlacedFeatures:
    """SIFT features of a frame with depth, strongest first.

    Attributes:
        descriptors: (n, 128) float32, RootSIFT, unit length.
        points: (n, 3) float64, metres, camera frame.
    """

    descriptors: NDArray[np.float32]
    points: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)


NO_FEATURES = PlacedFeatures(np.empty((0, 128), np.float32), np.empty((0, 3)))


@dataclass(eq=False)
class Keyframe:
    """A tracked frame with features.

    Attributes:
        T_world_camera: (4, 4) in its submap; corrected with the map.
        last_seen: Last time near its pose, seconds.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    features: PlacedFeatures
    submap: int = 0
    last_seen: float = -np.inf


@dataclass(frozen=True, eq=False)
class LastFrame:
    """The last tracked frame; its features are extracted when needed.

    Attributes:
        dynamic_mask: (H, W) bool, pixels without features; None for none.
    """

    keyframe: Keyframe
    observation: Observation
    dynamic_mask: NDArray[np.bool_] | None


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """A frame that shows the place of a keyframe.

    Attributes:
        T_world_camera: (4, 4) pose of the frame in the keyframe's submap.
        num_inliers: Feature matches that agree with the pose.
    """

    keyframe: Keyframe
    T_world_camera: NDArray[np.float64]
    num_inliers: int

    def verdict(self, found: TrackingResult, unit: float, static_share: float = 1.0) -> Verdict:
        """Whether a registration confirms the pose from features.

        ``unit``: reference depth, metres. ``static_share``: static share of the measurements.
        """
        distance, angle_deg = difference(found.T_world_camera, self.T_world_camera)
        seen = "only {figure:.0%} of the measurements are static and on the map"
        off = "the registration corrects the pose of the features by {figure:.2g} "
        return found.verdict + Verdict((
            Outcome.of("unobservable", len(found.unobservable), 0, "{figure:.0f} directions of motion are unobserved"),
            Outcome.of("on_map", static_share * found.inlier_share, MIN_ON_MAP, seen, at_least=True),
            Outcome.of("correction_m", distance, MAX_CORRECTION * unit, off + "m"),
            Outcome.of("correction_deg", angle_deg, MAX_CORRECTION_DEG, off + "deg"),
        ))  # fmt: skip


class KeyframeDatabase(Stateful):
    """Keyframes along the trajectory, and place recognition by their features.

    Another thread extracts features of new keyframes; ``settle`` waits for them. ``extract`` is not thread-safe.
    """

    keyframes: Remembered[list[Keyframe]]
    last: Remembered[LastFrame | None] = None
    _frames_since_last: Remembered[int]

    def __init__(self, config: RelocalizationConfig, camera: Camera, sensor: SensorConfig | None = None) -> None:
        self.config = config
        self.camera = camera
        self.sensor = sensor or SensorConfig()
        self.keyframes = []
        self._sift = SiftExtractor(MAX_FEATURES)
        self._frames_since_last = config.keyframe_gap
        self._unsettled: Callable[[], PlacedFeatures | None] = _nothing  # features of the newest keyframe

    def state(self) -> dict[str, Any]:
        """The keyframes with their features."""
        self.settle()
        return super().state()

    def extract(self, observation: Observation, dynamic_mask: NDArray[np.bool_] | None = None) -> PlacedFeatures:
        """SIFT features of a frame on one static surface. ``dynamic_mask``: (H, W) bool, excluded pixels; None =
        none."""
        self.settle()
        return self._extract(observation, dynamic_mask)

    def _extract(self, observation: Observation, dynamic_mask: NDArray[np.bool_] | None) -> PlacedFeatures:
        features = self._sift.extract(reduced_grey(observation.rgb, IMAGE_WIDTH))
        if len(features) == 0:
            return NO_FEATURES
        height, width = observation.depth.shape
        reduced_height, reduced_width = features.image_shape
        # pixel centres at integers in both images
        pixels = (features.pixels + 0.5) * (width / reduced_width, height / reduced_height) - 0.5
        depth, usable = _depth_at(observation.depth, pixels)
        if dynamic_mask is not None:
            usable &= ~np.any(_neighbourhood(dynamic_mask, pixels), axis=1)
        order = np.argsort(-features.responses, kind="stable")
        order = order[usable[order]][:MAX_FEATURES]
        u, v = pixels[order].T
        points = self.camera.points(u, v, depth[order].astype(np.float64))
        descriptors = features.descriptors[order]
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
        return PlacedFeatures(root.astype(np.float32), points)

    def add(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_] | None = None,
        submap: int = 0,
    ) -> bool:
        """Make a tracked frame a keyframe if none of its submap is near and ``relocalization.keyframe_gap`` frames have
        passed; call with every tracked frame.

        ``settle`` removes it if it has fewer than ``MIN_INLIERS`` features.
        """
        self.settle()
        self._frames_since_last += 1
        if self._frames_since_last <= self.config.keyframe_gap:
            return False
        if self.near(T_world_camera, submap, self.config.keyframe_distance, self.config.keyframe_angle_deg):
            return False
        self._frames_since_last = 0
        timestamp = observation.timestamp
        self.keyframes.append(Keyframe(timestamp, T_world_camera.copy(), NO_FEATURES, submap, timestamp))
        self._unsettled = submit(lambda: self._extract(observation, dynamic_mask))
        return True

    def remember(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        dynamic_mask: NDArray[np.bool_] | None = None,
        submap: int = 0,
    ) -> None:
        """Remember the last tracked frame, the first candidate for recognition."""
        timestamp = observation.timestamp
        place = Keyframe(timestamp, T_world_camera.copy(), NO_FEATURES, submap, timestamp)
        self.last = LastFrame(place, observation, dynamic_mask)

    @property
    def places(self) -> list[Keyframe]:
        """The keyframes and the last tracked frame."""
        return [*self.keyframes, *([] if self.last is None else [self.last.keyframe])]

    def recognise(self, features: PlacedFeatures) -> list[PlaceMatch]:
        """Places with these features: the last tracked frame, which needs half as many inliers, then keyframes."""
        if self.last is not None and len(self.last.keyframe.features) == 0:
            self.last.keyframe.features = self.extract(self.last.observation, self.last.dynamic_mask)
        last = [] if self.last is None else [self.last.keyframe]
        return self.match(features, last, MIN_INLIERS // 2) + self.match(features)

    def settle(self) -> None:
        """Wait for the newest features; remove a keyframe with too few."""
        features, self._unsettled = self._unsettled(), _nothing
        if features is None:
            return
        if len(features) < MIN_INLIERS:
            self.keyframes.pop()
            return
        self.keyframes[-1].features = features
        if len(self.keyframes) > self.config.max_keyframes:
            self._remove_most_redundant()

    def match(
        self, features: PlacedFeatures, among: Sequence[Keyframe] | None = None, min_inliers: int | None = None
    ) -> list[PlaceMatch]:
        """Keyframes that match the features, each with the frame's pose; distinct poses, most inliers first.

        ``among``: candidates (None = all). ``min_inliers``: None = ``MIN_INLIERS``.
        """
        among = self.keyframes if among is None else among
        fewest = MIN_INLIERS if min_inliers is None else min_inliers
        if len(features) < fewest or not among:
            return []
        found: list[PlaceMatch] = []
        for keyframe in _most_similar(features, among):
            pairs = match_descriptors(features.descriptors, keyframe.features.descriptors, RATIO)
            if len(pairs) < fewest:
                continue
            a, b = keyframe.features.points[pairs[:, 1]], features.points[pairs[:, 0]]
            T_keyframe_camera, inliers = rigid_ransac(a, b, self._tolerance(a) + self._tolerance(b), MIN_SHARE)
            num_inliers = int(np.count_nonzero(inliers))
            if num_inliers >= max(fewest, MIN_SHARE * len(pairs)):
                found.append(PlaceMatch(keyframe, keyframe.T_world_camera @ T_keyframe_camera, num_inliers))
        found.sort(key=lambda match: -match.num_inliers)
        distinct, nearby = list[PlaceMatch](), DUPLICATE_DISTANCE * self.sensor.reference_depth
        for match in found:
            if not any(
                match.keyframe.submap == other.keyframe.submap
                and agree(match.T_world_camera, other.T_world_camera, nearby, DUPLICATE_ANGLE_DEG)
                for other in distinct
            ):
                distinct.append(match)
        return distinct

    def near(
        self, T_world_camera: NDArray[np.float64], submap: int, distance: float, angle_deg: float
    ) -> list[Keyframe]:
        """Keyframes of a submap closer to a pose (4, 4) than a distance (m) and an angle (deg)."""
        if not self.keyframes:
            return []
        Ts = np.array([keyframe.T_world_camera for keyframe in self.keyframes])
        squares = (Ts[:, :3, 3] - T_world_camera[:3, 3]) ** 2 @ np.ones(3)
        cosine = (Ts[:, :3, :3].reshape(-1, 9) @ T_world_camera[:3, :3].reshape(9) - 1) / 2
        close = (squares < distance**2) & (cosine > math.cos(math.radians(angle_deg)))
        return [self.keyframes[n] for n in close.nonzero()[0] if self.keyframes[n].submap == submap]

    def _remove_most_redundant(self) -> None:
        Ts = np.array([keyframe.T_world_camera for keyframe in self.keyframes])
        distance = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
        cosine = (np.einsum("iab,jab->ij", Ts[:, :3, :3], Ts[:, :3, :3]) - 1) / 2
        angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        gap = np.maximum(distance / self.config.keyframe_distance, angle_deg / self.config.keyframe_angle_deg)
        submaps = np.array([keyframe.submap for keyframe in self.keyframes])
        gap[submaps[:, None] != submaps] = np.inf
        gap[np.tril_indices(len(Ts))] = np.inf
        del self.keyframes[int(np.unravel_index(np.argmin(gap), gap.shape)[0])]

    def _tolerance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        z = points[:, 2]
        return POSITION_ERROR * z + 2 * self.sensor.sigma(z)


def _nothing() -> None:
    """Placeholder while no features of a keyframe are pending."""


def _most_similar(features: PlacedFeatures, among: Sequence[Keyframe]) -> Iterable[Keyframe]:
    """The keyframes whose strongest features are most similar, best first."""
    if len(among) <= MAX_MATCHED:
        return among
    parts = [keyframe.features.descriptors[:COARSE_FEATURES] for keyframe in among]
    starts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    similarity = np.concatenate(parts) @ features.descriptors.T
    best = np.maximum.reduceat(similarity, starts, axis=0)  # per keyframe and feature of the frame
    distinctive = np.clip(best - np.median(best, axis=0), 0, None)
    return [among[n] for n in np.argsort(-distinctive.sum(axis=1), kind="stable")[:MAX_MATCHED]]


def _neighbourhood(image: NDArray, pixels: NDArray[np.float64]) -> NDArray:
    u, v = np.rint(pixels).astype(np.int64).T
    offsets = np.arange(-1, 2)
    rows = np.clip(v[:, None, None] + offsets[:, None], 0, image.shape[0] - 1)
    columns = np.clip(u[:, None, None] + offsets[None, :], 0, image.shape[1] - 1)
    return image[rows, columns].reshape(len(pixels), 9)


def _depth_at(depth: NDArray[np.float32], pixels: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    readings = _neighbourhood(depth, pixels)
    median = np.median(readings, axis=1)
    spread = readings.max(axis=1) - readings.min(axis=1)
    return median, (readings.min(axis=1) > 0) & (spread < 0.02 + 0.02 * median)
