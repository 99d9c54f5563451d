"""Formulas of the CPU kernels, compiled by Warp from the same source.

``warp_function`` replaces globals of a plain function by Warp's counterparts for ``wp.func``.
"""

import inspect
import math
import types
import typing

import numpy as np
import warp as wp
from numba.core.dispatcher import Dispatcher

from dudmap.core.backends.cpu import sampling
from dudmap.core.backends.threads import Scalar
from dudmap.core.formulas import pixel, residual, voxel

wp.set_module_options({"enable_backward": False})

Formula = Dispatcher | Scalar | types.FunctionType
Motion = wp.types.vector(12, wp.float32)
"""The elements of a rigid motion (3, 4), row by row."""


def motion_of(T: np.ndarray) -> wp.types.vector:
    """The elements of a matrix (3, 4) float32."""
    return Motion(*(float(value) for value in T.reshape(-1)))


@wp.func
def bit_and(a: wp.bool, b: wp.bool):
    """Conjunction of two truth values."""
    return a and b


@wp.func
def bit_and(a: wp.int32, b: wp.int32):
    """Bitwise conjunction of two words."""
    return wp.bit_and(a, b)


@wp.func
def bit_or(a: wp.bool, b: wp.bool):
    """Disjunction of two truth values."""
    return a or b


@wp.func
def bit_or(a: wp.int32, b: wp.int32):
    """Bitwise disjunction of two words."""
    return wp.bit_or(a, b)


@wp.func
def bits(word: wp.int32, shift: wp.int32, mask: wp.int32):
    """Bits of a word from ``shift`` upwards, as many as ``mask`` keeps, as a number."""
    return wp.float32((word >> shift) & mask)


@wp.func
def upper_half(word: wp.int32):
    """Upper 16 bits of a word as a signed number."""
    return wp.float32(word >> 16)


_NUMPY = types.SimpleNamespace(
    float32=wp.float32, float64=wp.float64, int32=wp.int32, int64=wp.int32, uint8=wp.uint8,
    floor=wp.floor, ceil=wp.ceil, sqrt=wp.sqrt, exp=wp.exp, sin=wp.sin, cos=wp.cos,
    minimum=wp.min, maximum=wp.max, where=wp.where,
)  # fmt: skip
"""Functions of NumPy and ``math`` in formulas; 64-bit indices fit into 32."""
_OF_NUMPY = {
    np.float32: wp.float32, np.float64: wp.float64, np.int32: wp.int32, np.int64: wp.int32, np.floor: wp.floor,
    np.sqrt: wp.sqrt, np.exp: wp.exp,
}  # fmt: skip
_OWN = {"bits": bits, "upper_half": upper_half}
_compiled: dict[Formula, wp.Function] = {}


def warp_function(formula: Formula) -> wp.Function:
    """Warp function of a formula, with all functions that it calls."""
    if formula not in _compiled:
        function = formula if isinstance(formula, types.FunctionType) else formula.py_func
        names = {**function.__globals__, "bit_and": bit_and, "bit_or": bit_or, **_OWN}
        for name in function.__code__.co_names:
            if name in function.__globals__ and name not in _OWN:
                names[name] = _counterpart(function.__globals__[name])
        twin = types.FunctionType(function.__code__, names, function.__name__)
        twin.__module__, twin.__qualname__ = function.__module__, function.__qualname__
        twin.__annotations__ = dict.fromkeys(inspect.signature(function).parameters, typing.Any)
        _compiled[formula] = wp.func(twin)
    return _compiled[formula]


def _counterpart(value: object) -> object:
    """Warp counterpart of a global of a formula."""
    if isinstance(value, Formula):
        return warp_function(value)
    if value is np or value is math:
        return _NUMPY
    if isinstance(value, np.float32):
        return wp.constant(wp.float32(float(value)))
    if isinstance(value, float):  # also one of NumPy
        return wp.constant(wp.float64(float(value)))
    return _OF_NUMPY.get(value, value) if isinstance(value, type | np.ufunc) else value


rotate, transform = warp_function(pixel.rotate), warp_function(pixel.transform)
ray, project = warp_function(pixel.ray), warp_function(pixel.project)
sdf_steps, intensity_of = warp_function(voxel.sdf_steps), warp_function(voxel.intensity_of)
fuse_voxel, fuse_color = warp_function(voxel.fuse_voxel), warp_function(voxel.fuse_color)
is_occupied = warp_function(voxel.is_occupied)
trilinear, weigh = warp_function(residual.trilinear), warp_function(residual.weigh)
normal_terms, within_range = warp_function(residual.normal_terms), warp_function(residual.within_range)
corner_weight = warp_function(sampling.corner_weight)
