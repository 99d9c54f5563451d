"""Width of the vector registers that a kernel is compiled for."""

from numba.core import types
from numba.extending import intrinsic

WIDTH = 512
"""Bits; processors with shorter registers use their own width."""


@intrinsic
def wide_vectors(typing_context):
    """Compile the enclosing kernel's loops for ``WIDTH`` bits, if available; LLVM uses half by default. Only loops with
    much arithmetic gain."""

    def generate(context, builder, signature, arguments):
        set.add(builder.function.attributes, f'"prefer-vector-width"="{WIDTH}"')  # llvmlite only lists plain names
        return context.get_dummy_value()

    return types.void(), generate
