"""Memory operations that NumPy does not have."""

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

LINES = 16
"""Cache lines of one call of ``prefetch``: as many as a core of most processors can wait for; more of them at once hold
up the loads that follow."""
LINE = 64
"""Bytes of a cache line of most processors."""


@intrinsic
def prefetch(typing_context, array, index):
    """Prefetch ``LINES`` cache lines of a flat array from element ``index`` on: a hint, which changes no result."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        byte_pointer = ir.IntType(8).as_pointer()
        number = ir.IntType(32)
        hint = builder.module.declare_intrinsic(
            "llvm.prefetch", [byte_pointer], ir.FunctionType(ir.VoidType(), [byte_pointer, number, number, number])
        )
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), byte_pointer)
        read, all_caches, data_cache = number(0), number(3), number(1)
        for line in range(LINES):
            place = builder.gep(pointer, [number(LINE * line)])
            builder.call(hint, [place, read, all_caches, data_cache])
        return context.get_dummy_value()

    return types.void(array, index), generate
