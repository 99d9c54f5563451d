"""Loops over a map level's blocks: surface detail, and initial values of finer blocks.

Blocks are read with two voxels around (``VoxelBlocks.neighbourhood``).
"""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu.surroundings import surrounded
from dudmap.core.backends.threads import bands, kernel, run_bands, scalar
from dudmap.core.formulas.voxel import intensity_of, pack_color, pack_voxel, sdf_steps

PAD = 2
SIZE = 8 + 2 * PAD
NEAR = np.float32(1)
"""Distance from the surface, voxels, within which the field is examined."""
SATURATED = np.float32(0.85)
"""Share of the truncation band beyond which distances may be truncated."""
PRIOR = 8
"""Weight that a voxel inherits: two frontal measurements at one metre."""
BAND = 64


@scalar
def distance_bend(word, a, b, by_voxel, saturated):
    """Second derivative of the distance, per voxel, from voxels two steps away, and whether known; see
    ``examine_range``."""
    f, fa, fb = sdf_steps(word) * by_voxel, sdf_steps(a) * by_voxel, sdf_steps(b) * by_voxel
    known = ((a & 0xFF00) != 0) & ((b & 0xFF00) != 0) & (fa < saturated) & (fb < saturated)
    return (fa - f - f + fb) * np.float32(0.25), known


@scalar
def intensity_bend(word, a, b):
    """Second derivative of the intensity (0..1), and whether known."""
    known = ((a & 0xFF) != 0) & ((b & 0xFF) != 0) & ((word & 0xFF) != 0)
    return (intensity_of(a) + intensity_of(b) - np.float32(2) * intensity_of(word)) / np.float32(255), known


@scalar
def root_mean(total, count):
    """Root mean square from a sum of squares."""
    return np.sqrt(total / np.float32(max(count, 1)))


@scalar
def mean_voxel(steps, count, weight, shade, shades):
    """Word of the mean of ``count`` voxels from sums of distances and ``shades`` intensities; 0 = unknown, if the
    weight is 0."""
    by = np.float32(1) / np.float32(max(shades, 1))
    word = pack_voxel(steps / np.float32(count), np.float32(weight), shade * by)
    return np.int32(word) if weight > 0 else np.int32(0)


@scalar
def mean_color(red, green, blue, count):
    """Word of the mean of ``count`` colours; 0 = none."""
    by = np.float32(1) / np.float32(max(count, 1))
    word = pack_color(red * by, green * by, blue * by)
    return np.int32(word) if count > 0 else np.int32(0)


@kernel
def examine_range(start, stop, geometry, near, by_voxel, saturated, bend, texture, surface):
    """Octants of blocks ``start`` to ``stop``, see ``examine``.

    With the distance f in voxels, D_a = (f(x + 2 e_a) - 2 f(x) + f(x - 2 e_a)) / 4 is its second derivative along axis
    a, about curvature times voxel size in sum. Linear interpolation errs by an eighth; the bend is the root mean square
    of |D| near the surface, the texture the same of intensity with steps of one voxel.
    """
    words = np.empty((SIZE, SIZE, SIZE), np.int32)
    flat = words.reshape(-1)
    zero = np.float32(0)
    for row in range(start, stop):
        surrounded(geometry, near[row], words)
        for octant in range(8):
            x0 = PAD + 4 * (octant >> 2)
            y0 = PAD + 4 * ((octant >> 1) & 1)
            z0 = PAD + 4 * (octant & 1)
            total, shades, count, shaded = zero, zero, 0, 0
            inside, outside = False, False
            for i in range(5):
                for j in range(5):
                    for k in range(5):
                        n = ((x0 + i) * SIZE + y0 + j) * SIZE + z0 + k
                        word = flat[n]
                        if word & 0xFF00 == 0:
                            continue
                        f = sdf_steps(word) * by_voxel
                        inside |= f < np.float32(0.25)
                        outside |= f > np.float32(-0.25)
                        if abs(f) > NEAR or i == 4 or j == 4 or k == 4:
                            continue
                        square, axes = zero, 0
                        shade, seen = zero, False
                        for axis in range(3):
                            step = SIZE * SIZE if axis == 0 else (SIZE if axis == 1 else 1)
                            d, known = distance_bend(word, flat[n + 2 * step], flat[n - 2 * step], by_voxel, saturated)
                            if known:
                                square += d * d
                                axes += 1
                            d, known = intensity_bend(word, flat[n + step], flat[n - step])
                            if known:
                                shade += d * d
                                seen = True
                        if axes > 0:  # at the end of a finer level not all axes are known
                            total += square * np.float32(3) / np.float32(axes)
                            count += 1
                        if seen:
                            shades += shade
                            shaded += 1
            bend[row, octant] = root_mean(total, count)
            texture[row, octant] = root_mean(shades, shaded)
            surface[row, octant] = inside and outside


@scalar
def _channel(value):
    return np.float32(value & 1023)


@kernel
def prolong_range(start, stop, geometry, colors, near, octants, slots, fine_geometry, fine_colors):
    """Blocks ``start`` to ``stop`` of ``prolong``."""
    words = np.empty((SIZE, SIZE, SIZE), np.int32)
    paint = np.empty((SIZE, SIZE, SIZE), np.int32)
    for row in range(start, stop):
        surrounded(geometry, near[row], words)
        surrounded(colors, near[row], paint)
        octant, slot = octants[row], slots[row]
        for n in range(512):
            i, j, k = n >> 6, (n >> 3) & 7, n & 7
            x, y, z = (
                PAD + 4 * (octant >> 2) + (i >> 1),
                PAD + 4 * ((octant >> 1) & 1) + (j >> 1),
                PAD + 4 * (octant & 1) + (k >> 1),
            )
            steps, shade, shades = np.float32(0), np.float32(0), 0
            red, green, blue, painted = np.float32(0), np.float32(0), np.float32(0), 0
            weight, count = PRIOR, 0
            for a in range(1 + (i & 1)):
                for b in range(1 + (j & 1)):
                    for c in range(1 + (k & 1)):
                        word, color = words[x + a, y + b, z + c], paint[x + a, y + b, z + c]
                        weight = min(weight, (word >> 8) & 0xFF)
                        steps += np.float32(word >> 16)
                        count += 1
                        if word & 0xFF != 0:
                            shade += np.float32(word & 0xFF)
                            shades += 1
                        if color != 0:
                            red += _channel(color >> 20)
                            green += _channel(color >> 10)
                            blue += _channel(color)
                            painted += 1
            fine_geometry[slot, n] = mean_voxel(steps, count, weight, shade, shades)
            fine_colors[slot, n] = mean_color(red, green, blue, painted)


def examine(
    geometry: NDArray[np.int32], near: NDArray[np.int32], by_voxel: float, saturated: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Bend of distance and intensity near the surface, per octant.

    Args:
        geometry: (slots, 512) int32 voxels of one level.
        near: (n, 27) int32 slots, -1 = none.
        by_voxel: Voxels per step.
        saturated: Distance of possible truncation, voxels.

    Returns:
        (n, 8) each: bend of distance, per voxel, and of intensity (0..1), float32; whether the surface is in the octant
        or touches it, uint8.
    """
    bend, texture = np.empty((2, len(near), 8), dtype=np.float32)
    surface = np.empty((len(near), 8), dtype=np.uint8)
    by, limit = np.float32(by_voxel), np.float32(saturated)
    run_bands(
        lambda start, stop: examine_range(start, stop, geometry, near, by, limit, bend, texture, surface),
        bands(len(near), BAND),
    )
    return bend, texture, surface


def prolong(
    geometry: NDArray[np.int32],
    colors: NDArray[np.int32],
    near: NDArray[np.int32],
    octants: NDArray[np.int64],
    slots: NDArray[np.int32],
    fine_geometry: NDArray[np.int32],
    fine_colors: NDArray[np.int32],
) -> None:
    """Fill blocks of half the voxel size by trilinear interpolation; a voxel is known if all around are, with their
    smallest weight, at most PRIOR.

    Args:
        geometry, colors: (coarse slots, 512) int32.
        near: (n, 27) int32 coarse slots around each parent, -1 = none.
        octants: (n,) of the parent.
        slots: (n,) int32.
        fine_geometry, fine_colors: (fine slots, 512) int32, changed here.
    """
    prolong_range(0, len(slots), geometry, colors, near, octants, slots, fine_geometry, fine_colors)
