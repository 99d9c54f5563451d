"""Memory operations that NumPy does not have."""

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from dudmap.core.backends.threads import scalar

LINES = 16
"""Cache lines per ``prefetch_quarter``: a quarter of a block. Most cores can load this many at once."""
LINE = 64


@intrinsic
def load_pair(typing_context, words, index):
    """Elements ``index`` and next of a flat int32 array as one int64, the first lower."""

    def generate(context, builder, signature, arguments):
        pair = ir.IntType(64)
        return builder.load(builder.bitcast(_place(context, builder, signature, arguments), pair.as_pointer()), align=4)

    return types.int64(words, types.uintp), generate


@intrinsic
def prefetch(typing_context, array, index):
    """Prefetch the cache line of an element."""

    def generate(context, builder, signature, arguments):
        byte_pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        hint = builder.module.declare_intrinsic(
            "llvm.prefetch", [byte_pointer], ir.FunctionType(ir.VoidType(), [byte_pointer, number, number, number])
        )
        read, all_caches, data_cache = number(0), number(3), number(1)
        place = builder.bitcast(_place(context, builder, signature, arguments), byte_pointer)
        builder.call(hint, [place, read, all_caches, data_cache])
        return context.get_dummy_value()

    return types.void(array, types.uintp), generate


def _place(context, builder, signature, arguments):
    """Address of an element of a flat array."""
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    return builder.gep(data, [arguments[1]])


@scalar
def prefetch_quarter(words, index):
    """Prefetch a quarter of a block of 32-bit words."""
    for line in range(LINES):
        prefetch(words, index + np.uintp(line * LINE // 4))
