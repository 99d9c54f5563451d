"""Inputs, parameters and results of the back-end operations (``core/backends/spec.py``).

Numba compiles named tuples directly. Tuples of parameters hold only floats; ``single`` converts them to float32 for
loops.
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
    """The tuple, including nested ones, with every number as float32; cached per type and value."""
    make: Any = type(parameters)
    return make(*(single(value) if isinstance(value, tuple) else np.float32(value) for value in parameters))


class SensorNoise(NamedTuple):
    """Standard deviation of a depth measurement: sigma(z) = base + scale z^2 (thesis eq. 3.91).

    Attributes:
        base: Metres.
        scale: 1/m.
        reference: Reference depth, metres, at which noise is compared.
    """

    base: float
    scale: float
    reference: float = 1.0


class TruncationBand(NamedTuple):
    """Band around a surface in which distances are stored; ``core/formulas/pixel.py`` computes its width at a depth.

    Attributes:
        front, behind: Smallest width on either side of the surface, metres.
        sigmas: Smallest width, standard deviations of the depth.
        limit: Largest distance that a voxel can store, metres.
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
        voxel_size: Edge of a voxel, metres.
        sdf_unit: Metres per step of the stored distance.
        depth_unit: Metres per step of 16-bit depth.
        max_weight: Cap of a voxel's weight.
        max_readings: Cap of a voxel's weight as a multiple of the weight of the fused measurement.
        carve_rate: Weight of an observation of emptiness in a voxel that holds a surface.
        depth_min, depth_max: Depth range, metres.
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
        band: Truncation band; pixels farther from the surface are outliers.
        huber: Huber constant of the distance residual, metres at the reference depth.
        color_weight, color_huber: Weight and Huber constant of the intensity residual (0..1), used in the range from
            ``darkest`` to ``brightest``.
        sigma_at_reference: Each distance residual is scaled by this sigma, metres, over sigma(z).
    """

    band: TruncationBand
    huber: float
    color_weight: float
    color_huber: float
    sigma_at_reference: float
    darkest: float = -np.inf
    brightest: float = np.inf


class ColorProjection(NamedTuple):
    """Projection of points of the depth camera into the colour image (``cpu/color_registration.py``).

    Attributes:
        place, speed, bend: (3, 4) float32; point X is at place X - tau speed X + tau^2 / 2 bend X at time tau.
        intrinsics: (4,) float32 of the colour camera.
        distortion: (5,) float32 k1, k2, p1, p2, k3 of the colour camera.
        offset: Time of the middle row of the colour image minus time of the middle row of the depth image, s.
        readout: Time from the first to the last row of the colour image, s.
        height: Rows of the colour image.
        vignetting: Logarithm of the brightness in the middle of the colour image over the brightness in its corners.
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
    """Limits of a view of the map: depths in metres, and the smallest weight of a trusted voxel (at least 1)."""

    depth_min: float
    depth_max: float
    min_weight: int


class MeshParameters(NamedTuple):
    """Parameters of the surface extraction.

    Attributes:
        voxel_size: Edge of a voxel, metres.
        sdf_unit: Metres per step of the stored distance.
        min_weight: Smallest weight of the corners of a meshed cell (at least 1).
        max_jump: Largest change of the distance within a meshed cell, metres.
    """

    voxel_size: float
    sdf_unit: float
    min_weight: int
    max_jump: float = np.inf


class FilterParameters(NamedTuple):
    """Parameters of the preprocessing of a depth image (thesis section 4.3).

    Attributes:
        depth_min, depth_max: Depth range that is kept, metres.
        drop_mixed: Whether pixels between foreground and background are dropped.
        steepest: Depth step per pixel of the steepest surface that is kept, as a share of the depth.
        fill_holes: Whether small holes are filled.
        hole_noise: Depth difference around a small hole that is always allowed, metres.
        smooth: Whether the bilateral filter is applied.
        alpha: sigma_c = alpha z^2 of the bilateral filter, and allowed depth difference around a hole, 1/m.
        sigma_px: Spatial standard deviation, pixels.
        radius: Half width of the window, pixels.
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
        """Weights (radius + 1,) of the bilateral filter by the distance from its centre, pixels."""
        return np.exp(-(np.arange(self.radius + 1) ** 2) / (2 * self.sigma_px**2)).astype(np.float32)


class VoxelGrid(NamedTuple):
    """The blocks of the map around the view.

    Voxels and window are arrays, or mirrors with a copy on a device.

    Attributes:
        window: (Wx * Wy * Wz,) int32: slot of the voxels of a block; -1 = unknown; -2 - entry = without voxels.
        shape: (3,) int64 blocks along each axis.
        origin: (3,) int64 coordinates of the first block.
        geometry: (slots, 512) int32 packed voxels.
        colors: (slots, 512) int32 packed colours.
        slot_coords: (slots, 3) int32 block coordinates by slot.
        free_count: (entries,) uint8 observations of emptiness of blocks without voxels.
        voxel_size: Edge of a voxel, metres.
        sdf_unit: Metres per step of the stored distance.
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
    """Camera to the lattice of a window (3, 4) float32: voxels, origin at the first voxel of its first block (3,)."""
    T = T_world_camera[:3] / voxel_size
    T[:, 3] -= origin * BLOCK
    return T.astype(np.float32)


class DepthTiles(NamedTuple):
    """Depth range and share of pixels with depth, per tile of 8x8 pixels.

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
        used: (H, W) bool, pixels to fuse; the others change nothing.
        weights: (H, W) uint8 weight of each pixel; None = cos(theta) / sigma(z) (thesis eq. 4.20).
        intrinsics: (4,) float32 fx, fy, cx, cy.
        T_grid_camera: (3, 4) float32, camera to the window's lattice, voxels.
        T_camera_world: (3, 4) float32, world to camera, metres, relative to the local origin of the window.
        T_world_camera: (4, 4) float64, camera to the world of the map.
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
        weights: (h, w) float32 static weights in [0, 1]; not used by ``sample``.
        intrinsics: (4,) float32 fx, fy, cx, cy.
    """

    depth: NDArray[np.float32]
    intensity: NDArray[np.float32]
    weights: NDArray[np.float32]
    intrinsics: NDArray[np.float32]


class FreeSpace(NamedTuple):
    """Selection of blocks without voxels that are observed as empty: every second plane of the window.

    Attributes:
        parity: 0 or 1, the first plane.
        after: Observations that make a block known free space; it is not visited again.
    """

    parity: int
    after: int


class BlockVisit(NamedTuple):
    """Blocks of a level that an image may be averaged into.

    Attributes:
        candidates: (n,) int32 slots that may be in view.
        fused: (slots,) uint8 frames that were fused into each slot.
        turn: Number of the frame, by which far blocks alternate; negative = all blocks are updated.
        repeats: Number of equal frames that this frame stands for.
        free_space: Selection of the empty blocks to observe; None = none.
    """

    candidates: NDArray[np.int32]
    fused: NDArray[np.uint8]
    turn: int
    repeats: int
    free_space: FreeSpace | None


class TouchedBlocks(NamedTuple):
    """An image prepared for fusion, and the blocks that it touches.

    Attributes:
        cells: (n,) int32, ascending, window cells of blocks without voxels that its truncation bands touch.
        depth: (H, W) float32, metres, depth to fuse, 0 = none.
        weights: (H, W) uint8, weight of each pixel.
        tiles: Depth ranges of the tiles of the image.
    """

    cells: NDArray[np.int32]
    depth: NDArray[np.float32]
    weights: NDArray[np.uint8]
    tiles: DepthTiles


class FusedBlocks(NamedTuple):
    """Blocks that a frame was fused into.

    Attributes:
        slots: (n,) int32.
        occupied: (n,) int32 voxels of each that hold a surface or were never observed.
        empty: (m,) int32 window cells without an entry that were observed as empty; the caller stores them.
    """

    slots: NDArray[np.int32]
    occupied: NDArray[np.int32]
    empty: NDArray[np.int32]


class ImageStack(Protocol):
    """Images of one size by number: an array (n, h, w), or images on a device, downloaded when they are read."""

    def __getitem__(self, number: int, /) -> NDArray[np.float32]: ...


class NormalEquations(NamedTuple):
    """One linearisation of the registration: ``H step = -b``.

    Attributes:
        H: (6, 6) float64, twist (v, omega) about the camera's centre in world axes.
        b: (6,) float64, gradient of the cost.
        cost: Robust cost; pixels off the map add a constant, so that poses can be compared.
        num_inliers: Number of pixels on the map.
        readings: Sum of the static weights of all pixels with depth.
        weight: Sum of the static weights of the pixels on the map.
        chi_square: Robustly weighted sum of squared distances, m^2 at one metre.
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
    """The map at the points of a depth image.

    Attributes:
        distance: (h, w) float32 signed distance in metres, NaN if unknown.
        difference: (h, w) float32 map minus image intensity (0..1), NaN if unknown.
        occupancy: (h, w) uint8: UNKNOWN (also without depth), SURFACE or FREE.
    """

    distance: NDArray[np.float32]
    difference: NDArray[np.float32]
    occupancy: NDArray[np.uint8]


class RaycastResult(NamedTuple):
    """The map rendered at a pose: the thesis' artificial camera view.

    Attributes:
        depth: (H, W) float32, metres, 0 = no surface.
        color: (H, W, 3) uint8.
        normals: (H, W, 3) float32, world frame, unit length, 0 = no surface.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    normals: NDArray[np.float32]
