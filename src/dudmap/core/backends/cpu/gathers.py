"""Loads of scattered voxels by vector instructions.

A loop that loads from one array at places that another array names and stores what it finds is not vectorised: LLVM
cannot prove that the stores leave the places alone. Here the vector instruction is written down; where a processor has
none, LLVM makes single loads of it.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 8
"""Points that one call works on: addresses have 64 bits, and the longest registers 512."""
STEPS = 0, 8, 64, 72
"""Distances from a voxel of a block of 8x8x8 to its neighbours at (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)."""

I32, I64 = ir.IntType(32), ir.IntType(64)
INTS, LONGS, FLAGS = (ir.VectorType(number, LANES) for number in (I32, I64, ir.IntType(1)))
PLACES = ir.VectorType(ir.PointerType(), LANES)


@intrinsic
def load_voxels(typing_context, window, geometry, cells, voxels, crossing, start, words, row):
    """Words of the eight voxels around ``LANES`` points whose eight voxels lie in one block; 0 for the others, and
    where there are no voxels.

    Args:
        window: (cells,) int32 voxel slots, negative = no voxels.
        geometry: (slots * 512,) int32 packed voxels.
        cells: (n,) int32, cell of the window that holds each point.
        voxels: (n,) int32, number within the block of the voxel at its lower corner.
        crossing: (n,) int32, 0 where the eight voxels lie in one block.
        start: First of the points.
        words: (8 * row,) int32 out, a row of words for each corner 4 dx + 2 dy + dz.
        row: Length of a row.
    """

    def generate(context, builder, signature, arguments):
        def data(number):
            return context.make_array(signature.args[number])(context, builder, arguments[number]).data

        def loaded(number):
            place = builder.gep(data(number), [start])
            return builder.load(builder.bitcast(place, INTS.as_pointer()), align=4)

        start, row_length = arguments[5], arguments[7]
        slot = _gathered(builder, data(0), builder.sext(loaded(2), LONGS), INTS)
        unknown = builder.ashr(slot, ir.Constant(INTS, [31] * LANES))  # all bits, or none
        elsewhere = builder.sub(ir.Constant(INTS, [0] * LANES), loaded(4))
        used = builder.sext(builder.not_(builder.or_(unknown, elsewhere)), LONGS)
        first = builder.shl(builder.sext(slot, LONGS), _every(9))
        own = builder.and_(builder.add(first, builder.sext(loaded(3), LONGS)), used)
        for number, step in enumerate(STEPS):
            pair = builder.and_(_gathered(builder, data(1), builder.add(own, _every(step)), LONGS), used)
            for corner, word in ((2 * number, pair), (2 * number + 1, builder.lshr(pair, _every(32)))):
                place = builder.add(builder.mul(row_length, I64(corner)), start)
                target = builder.bitcast(builder.gep(data(6), [place]), INTS.as_pointer())
                builder.store(builder.trunc(word, INTS), target, align=4)
        return context.get_dummy_value()

    index = types.intp
    return types.void(window, geometry, cells, voxels, crossing, index, words, index), generate


@intrinsic
def load_voxels_of_blocks(typing_context, window, size_y, size_z, geometry, cells, voxels, points, start, words, row):
    """Words of the eight voxels around ``LANES`` points, whatever blocks they lie in; 0 where there are no voxels.

    Args:
        window, geometry, cells, voxels, words, row: As for ``load_voxels``.
        size_y, size_z: Blocks of the window.
        points: (n,) int32 numbers of points.
        start: First of these numbers.
    """

    def generate(context, builder, signature, arguments):
        def data(number):
            return context.make_array(signature.args[number])(context, builder, arguments[number]).data

        size_y, size_z, start, row_length = (arguments[number] for number in (1, 2, 7, 9))
        point = builder.bitcast(builder.gep(data(6), [start]), INTS.as_pointer())
        point = builder.sext(builder.load(point, align=4), LONGS)
        cell, voxel = (builder.sext(_gathered(builder, data(number), point, INTS), LONGS) for number in (4, 5))
        planes = builder.mul(size_y, size_z), size_z, I64(1)
        axes = []  # what leads to the next voxel along each axis: cells, voxels
        for shift, cells_between in zip((6, 3, 0), planes, strict=True):
            local = builder.and_(builder.lshr(voxel, _every(shift)), _every(7))
            crosses = builder.sub(
                _every(0), builder.lshr(builder.add(local, _every(1)), _every(3))
            )  # all bits, or none
            back = builder.and_(crosses, _every(8 << shift))
            axes.append((builder.and_(crosses, _splat(builder, cells_between)), builder.sub(_every(1 << shift), back)))
        for corner in range(8):
            at, place = cell, voxel
            for axis, bit in enumerate((4, 2, 1)):
                if corner & bit:
                    at, place = builder.add(at, axes[axis][0]), builder.add(place, axes[axis][1])
            slot = _gathered(builder, data(0), at, INTS)
            known = builder.not_(builder.ashr(slot, ir.Constant(INTS, [31] * LANES)))
            place = builder.add(builder.shl(builder.sext(slot, LONGS), _every(9)), place)
            place = builder.and_(place, builder.sext(known, LONGS))
            word = builder.and_(_gathered(builder, data(3), place, INTS), known)
            first = _splat(builder, builder.mul(row_length, I64(corner)))
            _scatter(builder, word, data(8), builder.add(first, point))
        return context.get_dummy_value()

    index = types.intp
    return types.void(window, index, index, geometry, cells, voxels, points, index, words, index), generate


@intrinsic
def load_pairs(typing_context, pairs, places, out):
    """Pairs of words at places that an array names, and the largest of the upper halves of the first words, int64.

    Args:
        pairs: (2 * n,) int32.
        places: (m,) int32, numbers of pairs; m is a multiple of ``LANES``.
        out: (m,) int64 out, the pair of each number.
    """

    def generate(context, builder, signature, arguments):
        arrays = [
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        largest = cgutils.alloca_once_value(builder, _every(0))
        with cgutils.for_range(builder, builder.udiv(arrays[1].nitems, I64(LANES))) as loop:
            start = builder.mul(loop.index, I64(LANES))
            place, target = (builder.gep(array.data, [start]) for array in arrays[1:])
            number = builder.sext(builder.load(builder.bitcast(place, INTS.as_pointer()), align=4), LONGS)
            pair = _gathered(builder, arrays[0].data, builder.shl(number, _every(1)), LONGS)
            builder.store(pair, builder.bitcast(target, LONGS.as_pointer()), align=8)
            half, before = builder.and_(builder.lshr(pair, _every(16)), _every(0xFFFF)), builder.load(largest)
            builder.store(builder.select(builder.icmp_unsigned(">", half, before), half, before), largest)
        reduced = builder.module.declare_intrinsic(
            f"llvm.vector.reduce.umax.v{LANES}i64", (), ir.FunctionType(I64, [LONGS])
        )
        return builder.call(reduced, [builder.load(largest)])

    return types.int64(pairs, places, out), generate


def _every(value):
    """The same constant in each lane."""
    return ir.Constant(LONGS, [value] * LANES)


def _splat(builder, value):
    """The same 64-bit number in each lane."""
    undefined = ir.Constant(LONGS, ir.Undefined)
    first = builder.insert_element(undefined, value, I32(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTS, [0] * LANES))


def _places(builder, data, index):
    """Addresses of the 32-bit words ``index``."""
    base = _splat(builder, builder.ptrtoint(data, I64))
    return builder.inttoptr(builder.add(base, builder.shl(index, _every(2))), PLACES)


def _gathered(builder, data, index, kind):
    """``kind`` at places ``index`` of 32-bit words."""
    name = f"llvm.masked.gather.v{LANES}i{kind.element.width}.v{LANES}p0"
    gather = builder.module.declare_intrinsic(name, (), ir.FunctionType(kind, [PLACES, I32, FLAGS, kind]))
    places = _places(builder, data, index)
    return builder.call(gather, [places, I32(4), ir.Constant(FLAGS, [1] * LANES), ir.Constant(kind, ir.Undefined)])


def _scatter(builder, values, data, index):
    """Store 32-bit words at places ``index``."""
    name = f"llvm.masked.scatter.v{LANES}i32.v{LANES}p0"
    scatter = builder.module.declare_intrinsic(name, (), ir.FunctionType(ir.VoidType(), [INTS, PLACES, I32, FLAGS]))
    builder.call(scatter, [values, _places(builder, data, index), I32(4), ir.Constant(FLAGS, [1] * LANES)])
