"""Inputs, parameters and results of back-end operations (``core/backends/spec.py``).

Numba compiles named tuples. Tuples of parameters hold only floats; ``single`` converts them to float32 for loops.
"""

from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.mirror import Mirror, on_host

BLOCK = 8
UNKNOWN, SURFACE, FREE = 0, 1, 2
"""Occupancy of a point: unknown, near a surface, in known free space."""

Parameters = TypeVar("Parameters", bound=tuple)


@lru_cache(maxsize=64, typed=True)
def single(parameters: Parameters) -> Parameters:
    """The tuple, also nested, with float32 numbers; cached."""
    make: Any = type(parameters)
    return make(*(single(value) if isinstance(value, tuple) else np.float32(value) for value in parameters))


class SensorNoise(NamedTuple):
    """Standard deviation of a depth measurement: sigma(z) = base + scale z^2 (thesis eq. 3.91).

    Attributes:
        base: Metres.
        scale: 1/m.
        reference: Reference depth, metres.
    """

    base: float
    scale: float
    reference: float = 1.0


class TruncationBand(NamedTuple):
    """Band around a surface with stored distances; see ``core/formulas/pixel.py``.

    Attributes:
        front, behind: Smallest widths, metres.
        sigmas: Smallest width, standard deviations.
        limit: Largest stored distance, metres.
        noise: Noise of the sensor.
    """

    front: float
    behind: float
    sigmas: float
    limit: float
    noise: SensorNoise


class FusionParameters(NamedTuple):
    """Parameters of the fusion of a depth image (thesis eq. 4.18-4.23).

    Attributes:
        band: Truncation band.
        voxel_size: Metres.
        sdf_unit: Metres per distance step.
        depth_unit: Metres per 16-bit step.
        max_weight: Cap of a voxel.
        max_readings: Cap as a multiple of a measurement's weight.
        carve_rate: Weight of emptiness in a voxel with a surface.
        depth_min, depth_max: Metres.
    """

    band: TruncationBand
    voxel_size: float
    sdf_unit: float
    depth_unit: float
    max_weight: float
    max_readings: float
    carve_rate: float
    depth_min: float
    depth_max: float


class RegistrationParameters(NamedTuple):
    """Parameters of the robust cost of a registration (thesis eq. 4.32-4.46).

    Attributes:
        band: Farther pixels are outliers.
        huber: Of the distance residual, metres at the reference depth.
        color_weight, color_huber: Of the intensity residual (0..1), between ``darkest`` and ``brightest``.
        sigma_at_reference: Distance residuals are scaled by it, metres, over sigma(z).
    """

    band: TruncationBand
    huber: float
    color_weight: float
    color_huber: float
    sigma_at_reference: float
    darkest: float = -np.inf
    brightest: float = np.inf


class ColorProjection(NamedTuple):
    """Projection of depth camera points into the colour image (``cpu/color_registration.py``).

    Attributes:
        place, speed, bend: (3, 4) float32; X is at place X - tau speed X + tau^2 / 2 bend X at time tau.
        intrinsics: (4,) float32, colour camera.
        distortion: (5,) float32 k1, k2, p1, p2, k3.
        offset: Middle row of colour minus depth, s.
        readout: First to last colour row, s.
        height: Colour rows.
        vignetting: Log brightness, centre over corners.
    """

    place: NDArray[np.float32]
    speed: NDArray[np.float32]
    bend: NDArray[np.float32]
    intrinsics: NDArray[np.float32]
    distortion: NDArray[np.float32]
    offset: float
    readout: float
    height: int
    vignetting: float


class RaycastParameters(NamedTuple):
    """Limits of a view: depths in metres, smallest trusted weight (at least 1)."""

    depth_min: float
    depth_max: float
    min_weight: int


class MeshParameters(NamedTuple):
    """Parameters of the surface extraction.

    Attributes:
        voxel_size: Metres.
        sdf_unit: Metres per distance step.
        min_weight: Of a meshed cell's corners (at least 1).
        max_jump: Largest distance change in a meshed cell, metres.
    """

    voxel_size: float
    sdf_unit: float
    min_weight: int
    max_jump: float = np.inf


class FilterParameters(NamedTuple):
    """Parameters of the preprocessing of a depth image (thesis section 4.3).

    Attributes:
        depth_min, depth_max: Kept range, metres.
        drop_mixed: Drop pixels between foreground and background.
        steepest: Depth step per pixel of the steepest surface, share of the depth.
        hole_noise: Allowed depth difference around a hole, metres.
        smooth: Apply the bilateral filter.
        alpha: sigma_c = alpha z^2, and allowed difference around a hole, 1/m.
        sigma_px: Spatial standard deviation, pixels.
        radius: Of the window, pixels.
    """

    depth_min: float
    depth_max: float
    drop_mixed: bool
    steepest: float
    fill_holes: bool
    hole_noise: float
    smooth: bool
    alpha: float
    sigma_px: float
    radius: int

    @property
    def spatial_weights(self) -> NDArray[np.float32]:
        """Weights (radius + 1,) by distance from the centre, pixels."""
        return np.exp(-(np.arange(self.radius + 1) ** 2) / (2 * self.sigma_px**2)).astype(np.float32)


class VoxelGrid(NamedTuple):
    """The blocks of the map around the view.

    Voxels and window are arrays, or mirrors with a copy on a device.

    Attributes:
        window: (Wx * Wy * Wz,) int32: slot of a block; -1 = unknown; -2 - entry = without voxels.
        shape: (3,) int64 blocks along each axis.
        origin: (3,) int64 first block.
        geometry: (slots, 512) int32 packed voxels.
        colors: (slots, 512) int32 packed colours.
        slot_coords: (slots, 3) int32 block coordinates by slot.
        free_count: (entries,) uint8 observations of emptiness.
        voxel_size: Metres.
        sdf_unit: Metres per distance step.
    """

    window: Mirror | NDArray[np.int32]
    shape: NDArray[np.int64]
    origin: NDArray[np.int64]
    geometry: Mirror | NDArray[np.int32]
    colors: Mirror | NDArray[np.int32]
    slot_coords: NDArray[np.int32]
    free_count: NDArray[np.uint8]
    voxel_size: float
    sdf_unit: float

    def on_host(self) -> "VoxelGrid":
        """The grid with plain arrays, up to date."""
        window, geometry, colors = on_host(self.window), on_host(self.geometry), on_host(self.colors)
        return self._replace(window=window, geometry=geometry, colors=colors)


def to_lattice(
    T_world_camera: NDArray[np.float64], voxel_size: float, origin: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Camera to a window's lattice (3, 4) float32: voxels, origin at its first voxel."""
    T = T_world_camera[:3] / voxel_size
    T[:, 3] -= origin * BLOCK
    return T.astype(np.float32)


class DepthTiles(NamedTuple):
    """Depth range and share with depth, per 8x8 pixels.

    Attributes:
        nearest, farthest: (h, w) float32, metres; inf and 0 without depth.
        valid: (h, w) float32 in [0, 1].
    """

    nearest: NDArray[np.float32]
    farthest: NDArray[np.float32]
    valid: NDArray[np.float32]


class DepthView(NamedTuple):
    """A depth image to fuse, at a known pose.

    Attributes:
        depth: (H, W) float32, metres, 0 = none.
        color: (H, W, 3) uint8.
        used: (H, W) bool, pixels to fuse.
        weights: (H, W) uint8; None = cos(theta) / sigma(z) (thesis eq. 4.20).
        intrinsics: (4,) float32 fx, fy, cx, cy.
        T_grid_camera: (3, 4) float32, camera to lattice, voxels.
        T_camera_world: (3, 4) float32, world to camera, metres, relative to the window's local origin.
        T_world_camera: (4, 4) float64.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    used: NDArray[np.bool_]
    weights: NDArray[np.uint8] | None
    intrinsics: NDArray[np.float32]
    T_grid_camera: NDArray[np.float32]
    T_camera_world: NDArray[np.float32]
    T_world_camera: NDArray[np.float64]


class LevelImage(NamedTuple):
    """An image that is compared with the map.

    Attributes:
        depth: (h, w) float32, metres, 0 = none.
        intensity: (h, w) float32 in [0, 1].
        weights: (h, w) float32 static, in [0, 1]; not for ``sample``.
        intrinsics: (4,) float32 fx, fy, cx, cy.
    """

    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    weights: NDArray[np.float32]
    intrinsics: NDArray[np.float32]


class FreeSpace(NamedTuple):
    """Blocks observed as empty: every second plane of the window.

    Attributes:
        parity: First plane, 0 or 1.
        after: Observations of free space, not visited again.
    """

    parity: int
    after: int


class BlockVisit(NamedTuple):
    """Blocks of a level that an image may be averaged into.

    Attributes:
        candidates: (n,) int32 slots that may be in view.
        fused: (slots,) uint8 fused frames.
        turn: Frame number, by which far blocks alternate; negative = all.
        repeats: Equal frames that this one stands for.
        free_space: Empty blocks to observe; None = none.
    """

    candidates: NDArray[np.int32]
    fused: NDArray[np.uint8]
    turn: int
    repeats: int
    free_space: FreeSpace | None


class TouchedBlocks(NamedTuple):
    """An image prepared for fusion, and touched blocks.

    Attributes:
        cells: (n,) int32, ascending, touched window cells without voxels.
        depth: (H, W) float32, metres, 0 = none.
        weights: (H, W) uint8.
        tiles: Depth ranges.
    """

    cells: NDArray[np.int32]
    depth: NDArray[np.float32]
    weights: NDArray[np.uint8]
    tiles: DepthTiles


class FusedBlocks(NamedTuple):
    """Blocks that a frame was fused into.

    Attributes:
        slots: (n,) int32.
        occupied: (n,) int32 voxels with a surface or never observed.
        empty: (m,) int32 empty window cells without entry, for the caller to store.
    """

    slots: NDArray[np.int32]
    occupied: NDArray[np.int32]
    empty: NDArray[np.int32]


class ImageStack(Protocol):
    """Images by number: an array (n, h, w), or images on a device, downloaded when read."""

    def __getitem__(self, number: int, /) -> NDArray[np.float32]: ...


class NormalEquations(NamedTuple):
    """One linearisation of the registration: ``H step = -b``.

    Attributes:
        H: (6, 6) float64, twist (v, omega) about the camera's centre in world axes.
        b: (6,) float64, gradient of the cost.
        cost: Robust; pixels off the map add a constant.
        num_inliers: Pixels on the map.
        readings: Static weights of all pixels with depth.
        weight: Static weights on the map.
        chi_square: Robust sum of squared distances, m^2 at one metre.
        residuals: (2, h, w) float32, distance (m) and intensity difference, NaN off the map.
    """

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    cost: float
    num_inliers: int
    readings: float
    weight: float
    chi_square: float
    residuals: ImageStack


class MapSample(NamedTuple):
    """The map at a depth image's points.

    Attributes:
        distance: (h, w) float32, metres, NaN if unknown.
        difference: (h, w) float32, map minus image (0..1), NaN if unknown.
        occupancy: (h, w) uint8: UNKNOWN (also without depth), SURFACE or FREE.
    """

    distance: NDArray[np.float32]
    difference: NDArray[np.float32]
    occupancy: NDArray[np.uint8]


class RaycastResult(NamedTuple):
    """The rendered map: the thesis' artificial view.

    Attributes:
        depth: (H, W) float32, metres, 0 = none.
        color: (H, W, 3) uint8.
        normals: (H, W, 3) float32, world frame, unit length, 0 = none.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    normals: NDArray[np.float32]
