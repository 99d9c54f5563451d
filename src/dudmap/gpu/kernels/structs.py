"""Named tuples of ``kernels/parameters.py`` as structures of Warp: the same names, every number float32."""

from typing import Any

import warp as wp

from dudmap.kernels import parameters


@wp.struct
class SensorNoise:
    """See ``parameters.SensorNoise``."""

    base: wp.float32
    scale: wp.float32


@wp.struct
class TruncationBand:
    """See ``parameters.TruncationBand``."""

    front: wp.float32
    behind: wp.float32
    sigmas: wp.float32
    limit: wp.float32
    noise: SensorNoise


@wp.struct
class FusionParameters:
    """See ``parameters.FusionParameters``."""

    band: TruncationBand
    voxel_size: wp.float32
    sdf_unit: wp.float32
    depth_unit: wp.float32
    max_weight: wp.float32
    max_readings: wp.float32
    carve_rate: wp.float32
    depth_min: wp.float32
    depth_max: wp.float32


@wp.struct
class RegistrationParameters:
    """See ``parameters.RegistrationParameters``."""

    band: TruncationBand
    huber: wp.float32
    tukey: wp.float32
    color_weight: wp.float32
    color_huber: wp.float32
    sigma_at_one_metre: wp.float32
    noise_weighting: wp.float32


@wp.struct
class Camera:
    """Intrinsics of an image."""

    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32


@wp.struct
class Lattice:
    """The window of blocks around the view.

    Attributes:
        cells: Slot of the voxels of each block; -1 = unknown; -2 - entry = without voxels.
        geometry: (slots, 512) packed voxels.
        nx, ny, nz: Blocks along each axis.
    """

    cells: wp.array(dtype=wp.int32)
    geometry: wp.array2d(dtype=wp.int32)
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32


_STRUCTS: dict[type, Any] = {
    parameters.SensorNoise: SensorNoise,
    parameters.TruncationBand: TruncationBand,
    parameters.FusionParameters: FusionParameters,
    parameters.RegistrationParameters: RegistrationParameters,
}


def struct(values: tuple) -> Any:
    """The structure of a named tuple of parameters."""
    out = _STRUCTS[type(values)]()
    for name, value in values._asdict().items():
        setattr(out, name, struct(value) if isinstance(value, tuple) else float(value))
    return out
