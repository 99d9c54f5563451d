"""Formulas of a voxel: packed words, and fusion of a measurement (thesis eq. 4.18-4.23).

A voxel is two int32 words:
- geometry: sdf int16 (steps) << 16 | weight uint8 << 8 | intensity uint8;
- colour: red << 20 | green << 10 | blue, each in quarters of a grey level.

A pixel is two int32 words:
- depth << 16 | free depth, uint16 in ``depth_unit``; free space is certain up to the free depth;
- red << 24 | green << 16 | blue << 8 | weight.
"""

import numpy as np

from dudmap.core.backends.threads import scalar
from dudmap.core.formulas.pixel import band_behind, band_front
from dudmap.core.formulas.words import bits, upper_half

f32, i32, floor = np.float32, np.int32, np.floor
SURFACE_SHARE = f32(0.9)
"""Share of the truncation band near a surface."""
YOUNG = f32(8)
"""Weight below which a voxel without colour takes any measurement's in its band."""


@scalar
def sdf_steps(word):
    """Signed distance of a voxel in steps of ``sdf_unit``, float32."""
    return upper_half(word)


@scalar
def weight_of(word):
    """Weight of a voxel, float32; 0 = never observed."""
    return bits(word, 8, 0xFF)


@scalar
def intensity_of(word):
    """Intensity of a voxel, 1..255, float32; 0 = never observed near a surface."""
    return bits(word, 0, 0xFF)


@scalar
def pack_voxel(steps, weight, intensity):
    """Geometry word; distance and intensity are rounded, the weight truncated."""
    half = f32(0.5)
    return (i32(floor(steps + half)) << i32(16)) | (i32(weight) << i32(8)) | i32(intensity + half)


@scalar
def pack_color(red, green, blue):
    """Colour word from channels in quarters of a grey level, rounded."""
    half = f32(0.5)
    return (i32(red + half) << i32(20)) | (i32(green + half) << i32(10)) | i32(blue + half)


@scalar
def pack_reading(depth, free_depth, by_unit):
    """First word of a pixel, in steps of 1 / ``by_unit``."""
    return (i32(depth * by_unit + f32(0.5)) << i32(16)) | i32(free_depth * by_unit)


@scalar
def pack_pixel_color(red, green, blue, weight):
    """Second word of a pixel."""
    return (i32(red) << 24) | (i32(green) << 16) | (i32(blue) << 8) | i32(weight)


@scalar
def luma(color):
    """Intensity of a pixel's second word, 0..255 (ITU-R BT.601)."""
    value = f32(0.299) * bits(color, 24, 0xFF) + f32(0.587) * bits(color, 16, 0xFF)
    return value + f32(0.114) * bits(color, 8, 0xFF)


@scalar
def fuse_voxel(word, reading, color, z, repeats, by_sdf_unit, p):
    """Fuse the pixel that a voxel projects to.

    - Within the band, distance, weight and intensity are averaged.
    - Free space in front observes emptiness, ``carve_rate`` times in a voxel with a surface.
    - A black pixel changes no colour: the scene may be unlit.

    Args:
        word: Geometry word of the voxel.
        reading, color: Words of the pixel.
        z: Of the voxel, metres.
        repeats: Frames that this one stands for.
        by_sdf_unit: 1 / ``p.sdf_unit``.
        p: FusionParameters.

    Returns:
        New geometry word; the pixel's share in the new colour, -1 = only without one.
    """
    zero, one = f32(0), f32(1)
    d = bits(reading, 16, 0xFFFF) * p.depth_unit
    s = d - z
    tau = min(band_front(d, p.band), p.band.limit)
    observed = (d > zero) & (s > -min(band_behind(d, p.band), p.band.limit))
    banded = observed & (s < tau)
    empty = observed & (bits(reading, 0, 0xFFFF) * p.depth_unit > z)
    old_sdf, old_weight, old_intensity = sdf_steps(word) * p.sdf_unit, weight_of(word), intensity_of(word)
    carved = empty & (old_weight > zero) & (old_sdf < tau * SURFACE_SHARE)
    gain = bits(color, 0, 0xFF) * repeats
    gain = gain * p.carve_rate if carved else gain
    gain = gain if banded | empty else zero
    weight = old_weight + gain
    share = gain / max(weight, one)
    cap = max(old_weight, min(p.max_weight, p.max_readings * bits(color, 0, 0xFF)))
    sdf = old_sdf + (min(s, tau) - old_sdf) * share
    lit = bits(color, 8, 0xFFFFFF) > zero
    # intensity and colour belong to the surface: neither emptiness nor darkness changes them
    share = share if banded & lit else zero
    unlit = (old_intensity == zero) | (lit & (old_intensity == one))
    intensity_share = one if banded & unlit else share
    intensity = old_intensity + (max(luma(color), one) - old_intensity) * intensity_share
    fused = pack_voxel(sdf * by_sdf_unit, min(weight, cap), intensity)
    near = abs(s) < max(f32(2.5) * p.voxel_size, f32(0.4) * tau)
    color_share = share if near else (-one if banded & (old_weight < YOUNG) else zero)
    return i32(fused) if gain > zero else word, color_share


@scalar
def is_occupied(word, p):
    """Whether a voxel holds a surface or was never observed."""
    return (weight_of(word) == f32(0)) | (sdf_steps(word) * p.sdf_unit < p.band.front * SURFACE_SHARE)


@scalar
def fuse_color(old, color, share):
    """Colour word after a pixel's share; without colour (0) all of it."""
    share = max(share, f32(0)) if old != 0 else min(abs(share) * f32(1e6), f32(1))
    r0, g0, b0 = bits(old, 20, 0x3FF), bits(old, 10, 0x3FF), bits(old, 0, 0x3FF)
    r1, g1, b1 = bits(color, 22, 0x3FC), bits(color, 14, 0x3FC), bits(color, 6, 0x3FC)
    return pack_color(r0 + (r1 - r0) * share, g0 + (g1 - g0) * share, b0 + (b1 - b0) * share)
