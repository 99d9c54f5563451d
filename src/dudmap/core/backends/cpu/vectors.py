"""Width of the vector registers that a kernel is compiled for."""

from numba.core import types
from numba.extending import intrinsic

WIDTH = 512
"""Bits. Processors with shorter registers use their own width."""


@intrinsic
def wide_vectors(typing_context):
    """Compile the loops of the enclosing kernel for registers of ``WIDTH`` bits, if the processor has them.

    By default LLVM uses half of an AVX-512 register, because the first generation reduced its clock for longer ones.
    Only loops with much arithmetic per load gain.
    """

    def generate(context, builder, signature, arguments):
        set.add(builder.function.attributes, f'"prefer-vector-width"="{WIDTH}"')  # llvmlite only lists plain names
        return context.get_dummy_value()

    return types.void(), generate
