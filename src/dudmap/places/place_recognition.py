"""Lost and found: keyframes with features that have a place in space, and the poses they suggest for a lost frame.

SIFT features of a reduced image (Lowe 2004), compared as RootSIFT (Arandjelovic and Zisserman 2012), pose by RANSAC
over three pairs of points (Fischler and Bolles 1981) with the closed form of Kabsch (1976) and Umeyama (1991).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.config import RelocalizationConfig, SensorConfig
from dudmap.frames.observation import Observation
from dudmap.geometry.alignment import agree, rigid_ransac
from dudmap.geometry.camera import Camera

COMPARED = 64
"""Strongest features of each keyframe that choose the keyframes worth a closer look."""
LOOKED_AT = 5
"""KeyframeDatabase per lost frame that get that closer look."""
SLACK = 0.01
"""Two places of one feature differ by this beyond the sensor's noise, metres per metre of depth (half a pixel)."""
SAME_PLACE = 0.1, 5.0
"""Candidates nearer to each other than this (m, deg) are one."""


@dataclass(frozen=True, eq=False)
class PlacedFeatures:
    """Features of a frame that have a depth reading on one surface, strongest first.

    Attributes:
        descriptors: (n, 128) float32, unit length.
        points: (n, 3) float64, metres, camera frame.
    """

    descriptors: NDArray[np.float32]
    points: NDArray[np.float64]


@dataclass(eq=False)
class Keyframe:
    """A tracked frame that is remembered.

    Attributes:
        timestamp: Seconds.
        T_world_camera: (4, 4) in the world of its submap; moves when the map is corrected.
        features: What it is recognised by.
        submap: Number of the map it belongs to.
        last_seen: When the camera was last near, seconds.
    """

    timestamp: float
    T_world_camera: NDArray[np.float64]
    features: PlacedFeatures
    submap: int = 0
    last_seen: float = -np.inf


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """A keyframe that a frame was recognised to show.

    Attributes:
        keyframe: It.
        T_world_camera: (4, 4) pose of the frame in the world of the keyframe's submap.
        support: Matches that agree.
    """

    keyframe: Keyframe
    T_world_camera: NDArray[np.float64]
    support: int


class KeyframeDatabase:
    """Remembers where the camera has been, and recognises these places.

    Args:
        config: Distances, limits and thresholds.
        camera: Camera of the observations.
        sensor: Noise of the depth readings.
    """

    def __init__(self, config: RelocalizationConfig, camera: Camera, sensor: SensorConfig | None = None) -> None:
        self.config = config
        self.camera = camera
        self.sensor = sensor or SensorConfig()
        self.keyframes: list[Keyframe] = []
        self._detector: Any = None
        self._since_last = config.keyframe_gap
        self._latest: tuple[Observation, PlacedFeatures] | None = None

    def add(
        self,
        observation: Observation,
        T_world_camera: NDArray[np.float64],
        static_mask: NDArray[np.bool_] | None = None,
        submap: int = 0,
    ) -> bool:
        """Make a tracked frame a keyframe if the camera has been nowhere near; call with every tracked frame.

        Args:
            observation: The frame.
            T_world_camera: (4, 4).
            static_mask: (H, W) bool, pixels that do not move; None = all.
            submap: Number of the map it belongs to.

        Returns:
            Whether it became one.
        """
        self._since_last += 1
        if self._since_last <= self.config.keyframe_gap or self._near(T_world_camera, submap):
            return False
        self._since_last = 0
        features = self.features(observation, static_mask)
        if len(features.points) < self.config.min_inliers:
            return False
        stamp = observation.timestamp
        self.keyframes.append(Keyframe(stamp, T_world_camera.copy(), features, submap, stamp))
        if len(self.keyframes) > self.config.max_keyframes:
            self._forget_one()
        return True

    def find(self, observation: Observation, static_mask: NDArray[np.bool_] | None = None) -> list[PlaceMatch]:
        """Known places that a frame may show, the best supported first."""
        return self.match(self._features(observation, static_mask), self.keyframes) if self.keyframes else []

    def features(self, observation: Observation, static_mask: NDArray[np.bool_] | None = None) -> PlacedFeatures:
        """Features of a frame; the same frame again costs nothing."""
        if self._latest is None or self._latest[0] is not observation:
            self._latest = observation, self._features(observation, static_mask)
        return self._latest[1]

    def match(self, features: PlacedFeatures, among: Sequence[Keyframe]) -> list[PlaceMatch]:
        """KeyframeDatabase among these that a frame with such features may show, the best supported first."""
        if len(features.points) < self.config.min_inliers or not among:
            return []
        found: list[PlaceMatch] = []
        for keyframe in _most_alike(features, among):
            pairs = matches(features.descriptors, keyframe.features.descriptors, self.config.ratio)
            if len(pairs) < self.config.min_inliers:
                continue
            a, b = keyframe.features.points[pairs[:, 1]], features.points[pairs[:, 0]]
            T_keyframe_camera, inliers = rigid_ransac(a, b, self._tolerance(a) + self._tolerance(b))
            count = int(np.count_nonzero(inliers))
            if count >= max(self.config.min_inliers, self.config.min_share * len(pairs)):
                found.append(PlaceMatch(keyframe, keyframe.T_world_camera @ T_keyframe_camera, count))
        found.sort(key=lambda place: -place.support)
        places: list[PlaceMatch] = []
        for place in found:
            if not any(
                place.keyframe.submap == other.keyframe.submap
                and agree(place.T_world_camera, other.T_world_camera, *SAME_PLACE)
                for other in places
            ):
                places.append(place)
        return places

    def near(
        self, T_world_camera: NDArray[np.float64], submap: int, distance: float, angle_deg: float
    ) -> list[Keyframe]:
        """KeyframeDatabase of a submap closer to a pose than a distance (m) and an angle (deg)."""
        if not self.keyframes:
            return []
        places = np.array([known.T_world_camera for known in self.keyframes])
        close = np.linalg.norm(places[:, :3, 3] - T_world_camera[:3, 3], axis=1) < distance
        cosine = (np.einsum("iab,ab->i", places[:, :3, :3], T_world_camera[:3, :3]) - 1) / 2
        close &= np.degrees(np.arccos(np.clip(cosine, -1, 1))) < angle_deg
        return [self.keyframes[n] for n in np.flatnonzero(close) if self.keyframes[n].submap == submap]

    def _near(self, T_world_camera: NDArray[np.float64], submap: int) -> bool:
        return bool(self.near(T_world_camera, submap, self.config.keyframe_distance, self.config.keyframe_angle_deg))

    def _forget_one(self) -> None:
        """Drop the older of the two keyframes that lie nearest to each other."""
        places = np.array([known.T_world_camera for known in self.keyframes])
        apart = np.linalg.norm(places[:, None, :3, 3] - places[None, :, :3, 3], axis=-1)
        cosine = (np.einsum("iab,jab->ij", places[:, :3, :3], places[:, :3, :3]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        gap = np.maximum(apart / self.config.keyframe_distance, turned / self.config.keyframe_angle_deg)
        submaps = np.array([known.submap for known in self.keyframes])
        gap[submaps[:, None] != submaps] = np.inf
        gap[np.tril_indices(len(places))] = np.inf
        del self.keyframes[int(np.unravel_index(np.argmin(gap), gap.shape)[0])]

    def _tolerance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Largest believable error (n,) of a feature's place, metres."""
        z = points[:, 2]
        return SLACK * z + 2 * (self.sensor.sigma_base + self.sensor.sigma_scale * z**2)

    def _features(self, observation: Observation, static_mask: NDArray[np.bool_] | None) -> PlacedFeatures:
        import cv2

        if self._detector is None:
            self._detector = cv2.SIFT.create(nfeatures=self.config.max_features)
        height, width = observation.depth.shape
        scale = min(self.config.image_width / width, 1.0)
        grey = cv2.cvtColor(observation.rgb, cv2.COLOR_RGB2GRAY)
        size = round(width * scale), round(height * scale)
        if scale < 1:
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        keypoints, descriptors = self._detector.detectAndCompute(grey, None)
        if descriptors is None:
            return PlacedFeatures(np.empty((0, 128), np.float32), np.empty((0, 3)))
        # pixel centres at whole numbers in both images
        reduced = np.array([point.pt for point in keypoints])
        pixels = (reduced + 0.5) * (width / size[0], height / size[1]) - 0.5
        depth, single = _depth_at(observation.depth, pixels)
        used = single if static_mask is None else single & _all_around(static_mask, pixels)
        order = np.argsort([-point.response for point in keypoints], kind="stable")
        order = order[used[order]][: self.config.max_features]
        u, v = pixels[order].T
        z = depth[order].astype(np.float64)
        points = self.camera.points(u, v, z)
        root = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(axis=1, keepdims=True), 1e-9))
        return PlacedFeatures(root.astype(np.float32), points)


def _most_alike(features: PlacedFeatures, among: Sequence[Keyframe]) -> Iterable[Keyframe]:
    """KeyframeDatabase whose strongest features resemble the frame's most, the best first."""
    if len(among) <= LOOKED_AT:
        return among
    parts = [known.features.descriptors[:COMPARED] for known in among]
    starts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    similarity = np.concatenate(parts) @ features.descriptors.T
    best = np.maximum.reduceat(similarity, starts, axis=0)  # of each keyframe, for each feature
    unusual = np.clip(best - np.median(best, axis=0), 0, None)  # what many places show says nothing
    return [among[n] for n in np.argsort(-unusual.sum(axis=1), kind="stable")[:LOOKED_AT]]


def matches(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of rows of ``a`` and ``b`` that are each other's nearest, clearly nearer than the second in ``b``.

    Args:
        a: (n, d) unit vectors.
        b: (k, d) unit vectors.
        ratio: Largest quotient of the nearest and the second nearest distance (Lowe 2004).
    """
    if len(a) == 0 or len(b) < 2:
        return np.empty((0, 2), dtype=np.int64)
    cosine = a @ b.T
    nearest = np.argmax(cosine, axis=1)
    rows = np.arange(len(a))
    first = cosine[rows, nearest]
    mutual = np.argmax(cosine, axis=0)[nearest] == rows
    cosine[rows, nearest] = -1
    second = cosine.max(axis=1)
    distinct = 2 - 2 * first < ratio**2 * (2 - 2 * second)
    chosen = np.flatnonzero(mutual & distinct)
    return np.stack([chosen, nearest[chosen]], axis=1)


def _around(image: NDArray, pixels: NDArray[np.float64]) -> NDArray:
    """Values (n, 9) of the 3x3 pixels around places (n, 2) in an image, clamped at its border."""
    u, v = np.rint(pixels).astype(np.int64).T
    offsets = np.arange(-1, 2)
    rows = np.clip(v[:, None, None] + offsets[:, None], 0, image.shape[0] - 1)
    columns = np.clip(u[:, None, None] + offsets[None, :], 0, image.shape[1] - 1)
    return image[rows, columns].reshape(len(pixels), 9)


def _all_around(mask: NDArray[np.bool_], pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.all(_around(mask, pixels), axis=1)


def _depth_at(depth: NDArray[np.float32], pixels: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Depth (n,) around places, and whether all readings there lie on one surface: a corner at an edge is nowhere."""
    readings = _around(depth, pixels)
    middle = np.median(readings, axis=1)
    spread = readings.max(axis=1) - readings.min(axis=1)
    return middle, (readings.min(axis=1) > 0) & (spread < 0.02 + 0.02 * middle)
