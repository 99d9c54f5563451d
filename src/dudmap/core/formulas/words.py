"""Parts of packed words in 32-bit arithmetic, because Numba's 64 bits halve the throughput."""

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def bits(typing_context, word, shift, mask):
    """Bits of an int32 from ``shift``, by ``mask`` (at most 24), as float32."""

    def generate(context, builder, signature, arguments):
        word, shift, mask = (_as_int32(builder, argument) for argument in arguments)
        return builder.sitofp(builder.and_(builder.lshr(word, shift), mask), ir.FloatType())

    return types.float32(types.int32, shift, mask), generate


@intrinsic
def upper_half(typing_context, word):
    """Upper 16 bits of an int32 as a signed number, float32."""

    def generate(context, builder, signature, arguments):
        return builder.sitofp(builder.ashr(arguments[0], ir.IntType(32)(16)), ir.FloatType())

    return types.float32(types.int32), generate


def _as_int32(builder, value):
    return builder.trunc(value, ir.IntType(32)) if value.type.width > 32 else value
