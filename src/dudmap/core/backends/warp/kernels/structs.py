"""Named tuples of ``core/backends/parameters.py`` as Warp structures of float32."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dudmap.core.backends import parameters

Image = wp.array2d(dtype=wp.float32)
_STRUCTS: dict[type, Any] = {}


def _struct_of(kind: type) -> Any:
    fields = {name: _STRUCTS.get(one, wp.float32) for name, one in kind.__annotations__.items()}
    _STRUCTS[kind] = wp.struct(type(kind.__name__, (), {"__annotations__": fields, "__module__": __name__}))
    return _STRUCTS[kind]


SensorNoise = _struct_of(parameters.SensorNoise)
TruncationBand = _struct_of(parameters.TruncationBand)
FusionParameters = _struct_of(parameters.FusionParameters)
RegistrationParameters = _struct_of(parameters.RegistrationParameters)


@wp.struct
class Camera:
    """Intrinsics of an image."""

    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32


@wp.struct
class Lattice:
    """The window: slot of each block (-1 = unknown; -2 - entry = without voxels), (slots, 512) packed voxels, blocks
    along each axis."""

    cells: wp.array(dtype=wp.int32)
    geometry: wp.array2d(dtype=wp.int32)
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32


def struct(values: tuple) -> Any:
    """The structure of a named tuple of parameters."""
    out = _STRUCTS[type(values)]()
    for name, value in values._asdict().items():
        setattr(out, name, struct(value) if isinstance(value, tuple) else float(value))
    return out


def camera_of(intrinsics: NDArray[np.float32]) -> Any:
    """The structure of intrinsics (4,) fx, fy, cx, cy."""
    camera = Camera()
    camera.fx, camera.fy, camera.cx, camera.cy = (float(value) for value in intrinsics)
    return camera
