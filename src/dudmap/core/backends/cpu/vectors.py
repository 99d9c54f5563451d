"""Width of the vector registers that a kernel is compiled for."""

from numba.core import types
from numba.extending import intrinsic

WIDTH = 512
"""Bits. Processors with shorter registers use those they have."""


@intrinsic
def wide_vectors(typing_context):
    """Have the loops of the enclosing kernel use registers of ``WIDTH`` bits where the processor has them.

    LLVM uses half of an AVX-512 register unless a function asks for all of it, as its first generation slowed its clock
    down for longer ones. Only loops that calculate much per load gain.
    """

    def generate(context, builder, signature, arguments):
        set.add(builder.function.attributes, f'"prefer-vector-width"="{WIDTH}"')  # llvmlite only lists plain names
        return context.get_dummy_value()

    return types.void(), generate
