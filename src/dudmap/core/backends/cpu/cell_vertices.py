"""Vertex of a cell of a distance field, on the sharp edge of the surface that passes through it, if there is one.

A vertex minimises the squared distances to the tangent planes at the crossings of its cell (Ju et al. 2002). The
gradients in a cell with a sharp edge mix the surfaces on both sides of it, and say little. There the planes come from
crossings up to two cells away, weighed by how little the gradient changes along the edge of the lattice (compare the
feature-sensitive extraction of Kobbelt et al. 2001), and the vertex is where those meet that pass near it.

A field is flat float32 with ``size`` points along each edge, NaN where nothing is known; ``levels`` holds the level of
each cell of it (``octree_field.py``), ``top`` is the finest one, and a cell of a level has ``edge`` = 2^(top - level)
lattice steps along its edges.
"""

import numpy as np

from dudmap.core.backends.threads import kernel, scalar

f32 = np.float32
SMOOTH = f32(0.966)
"""Cosine of 15 degrees: where a normal of a cell is farther than this from their mean, or the gradients at the ends of
a crossed lattice edge from each other, an edge of the surface may be near."""
OWN_DAMPING, FEATURE_DAMPING = f32(0.1), f32(0.02)
"""Weight of the mean crossing relative to that of the planes; with two planes at a right angle, which give half of the
weight to each direction, a vertex reaches 96 % of the way to their edge."""
AGREEMENT = f32(0.01)
"""One minus the cosine of the change of the gradient along a lattice edge at which the weight of its plane falls to
1/e: 8 degrees."""
MIN_PLANES = f32(2)
"""Sum of the weights of the planes below which they are too few to place a vertex by."""
FIXED = f32(1e3)
"""Weight that holds a coordinate of a vertex on a face of its cell, relative to that of the planes."""


@scalar
def _gradient(field, size, n, step, out):
    """Gradient, times the lattice spacing, at point ``n``: central differences, one-sided beside unknown points."""
    here = field[n]
    for axis in range(3):
        stride = step * (size * size if axis == 0 else (size if axis == 1 else 1))
        high, low = field[n + stride], field[n - stride]
        has_high, has_low = not np.isnan(high), not np.isnan(low)
        if has_high and has_low:
            out[axis] = f32(0.5) * (high - low)
        elif has_high:
            out[axis] = high - here
        elif has_low:
            out[axis] = here - low
        else:
            out[axis] = f32(0)
    return np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])


@scalar
def _plane(field, size, a, b, t, step, ga, gb, normal):
    """Normal between points ``a`` and ``b``, and the cosine between the gradients there; 0 without a gradient."""
    la, lb = _gradient(field, size, a, step, ga), _gradient(field, size, b, step, gb)
    if la <= f32(0) or lb <= f32(0):
        return f32(0)
    agreement = (ga[0] * gb[0] + ga[1] * gb[1] + ga[2] * gb[2]) / (la * lb)
    square = f32(1e-20)
    for axis in range(3):
        normal[axis] = ga[axis] + (gb[axis] - ga[axis]) * t
        square += normal[axis] * normal[axis]
    scale = f32(1) / np.sqrt(square)
    for axis in range(3):
        normal[axis] *= scale
    return max(agreement, f32(1e-6))


@scalar
def _solve(A, b, damping, out):
    """Solution of (A + damping I) x = b for a symmetric A = (xx, xy, xz, yy, yz, zz)."""
    a00, a01, a02, a11, a12, a22 = A[0] + damping, A[1], A[2], A[3] + damping, A[4], A[5] + damping
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    det = a00 * c00 + a01 * c01 + a02 * c02
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    by = f32(1) / det
    out[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) * by
    out[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) * by
    out[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) * by


@scalar
def _add_plane(A, b, weight, normal, offset):
    """Add weight (n . x - offset)^2 to a quadratic form."""
    k = 0
    for i in range(3):
        b[i] += weight * normal[i] * offset
        for j in range(i, 3):
            A[k] += weight * normal[i] * normal[j]
            k += 1


@kernel
def is_known(field, size, x, y, z, edge, jump):
    """Whether all corners of a cell are known and the distance changes by no more than ``jump`` between them."""
    low, high = f32(np.inf), f32(-np.inf)
    for m in range(8):
        value = field[((x + edge * (m >> 2)) * size + y + edge * ((m >> 1) & 1)) * size + z + edge * (m & 1)]
        if np.isnan(value):
            return False
        low, high = min(low, value), max(high, value)
    return high - low <= jump


@kernel
def _known_leaf(field, levels, size, x, y, z, top, jump):
    """Whether the cell that holds the cell of the finest lattice at (x, y, z) is known, see ``is_known``."""
    level = np.int64(levels[(x * (size - 1) + y) * (size - 1) + z])
    edge = 1 << (top - level)
    x, y, z = x & ~(edge - 1), y & ~(edge - 1), z & ~(edge - 1)
    return is_known(field, size, x, y, z, edge, jump / f32(1 << level))


@scalar
def is_trusted(field, levels, size, x, y, z, axis, top, jump):
    """Whether two of the four cells around the lattice edge from (x, y, z) along an axis are known.

    One alone is the ragged end of what has been seen, where readings are worst.
    """
    known = 0
    for m in range(4):
        b, c = m >> 1, m & 1
        i = x - (0 if axis == 0 else b)
        j = y - (0 if axis == 1 else (b if axis == 0 else c))
        k = z - (0 if axis == 2 else c)
        known += 1 if _known_leaf(field, levels, size, i, j, k, top, jump) else 0
    return known > 1


@scalar
def _own_crossings(field, levels, size, x, y, z, edge, border, top, jump, work):
    """Crossings on the surface of a cell, with their normals, into the rows of ``work``: point, normal, and cosine
    between the gradients at the ends of the edge.

    Args:
        field, size: Field of the lattice, and its points along an edge.
        x, y, z: First point of the cell.
        edge: Lattice steps along an edge of the cell.
        levels, top, jump: As of ``contour_blocks``.
        border: Whether the cell is not known itself: then crossings count only beside a cell that is.
        work: (n, 7) float32 out.

    Returns:
        Number of crossings.
    """
    count = 0
    ga, gb, normal = np.empty(3, f32), np.empty(3, f32), np.empty(3, f32)
    for axis in range(3):
        stride = size * size if axis == 0 else (size if axis == 1 else 1)
        sb = size if axis == 0 else size * size
        sc = size if axis == 2 else 1
        first = (x * size + y) * size + z
        for b in range(edge + 1):
            for c in range(edge + 1):
                if 0 < b < edge and 0 < c < edge:
                    continue
                for a in range(edge):
                    p = first + a * stride + b * sb + c * sc
                    fp, fq = field[p], field[p + stride]
                    if np.isnan(fp) or np.isnan(fq) or (fp < 0) == (fq < 0):
                        continue
                    if border:
                        i = x + (a if axis == 0 else b)
                        j = y + (a if axis == 1 else (b if axis == 0 else c))
                        k = z + (a if axis == 2 else c)
                        if not is_trusted(field, levels, size, i, j, k, axis, top, jump):
                            continue
                    t = fp / (fp - fq)
                    agreement = _plane(field, size, p, p + stride, t, edge, ga, gb, normal)
                    if agreement <= f32(0) or count == len(work):
                        continue
                    row = work[count]
                    row[0], row[1], row[2] = f32(0), f32(0), f32(0)
                    row[axis] = f32(a) + t
                    row[1 if axis == 0 else 0] = f32(b)
                    row[1 if axis == 2 else 2] = f32(c)
                    for i in range(3):
                        row[3 + i] = normal[i]
                    row[6] = agreement
                    count += 1
    return count


@scalar
def _near_planes(field, size, x, y, z, edge, middle, planes):
    """Planes of crossings up to two cells away: normal, offset from ``middle``, and weight, into rows of ``planes``.

    Args:
        field, size, x, y, z, edge: As of ``_own_crossings``.
        middle: (3,) mean crossing of the cell, relative to it.
        planes: (n, 5) float32 out.

    Returns:
        Number of planes.
    """
    ga, gb, normal = np.empty(3, f32), np.empty(3, f32), np.empty(3, f32)
    offset = np.empty(3, f32)
    reach = f32(1) / f32(8 * edge * edge)  # a Gaussian of two cells
    count = 0
    for axis in range(3):
        step = edge * (size * size if axis == 0 else (size if axis == 1 else 1))
        for i in range(-2, 4):
            for j in range(-2, 4):
                for k in range(-2, 4):
                    if (i if axis == 0 else (j if axis == 1 else k)) == 3:
                        continue
                    px, py, pz = x + i * edge, y + j * edge, z + k * edge
                    ahead = (edge if axis == 0 else 0, edge if axis == 1 else 0, edge if axis == 2 else 0)
                    last = max(px + ahead[0], py + ahead[1], pz + ahead[2]) + edge
                    if min(px, py, pz) < edge or last >= size:
                        continue
                    p = (px * size + py) * size + pz
                    fp, fq = field[p], field[p + step]
                    if np.isnan(fp) or np.isnan(fq) or (fp < 0) == (fq < 0) or count == len(planes):
                        continue
                    t = fp / (fp - fq)
                    agreement = _plane(field, size, p, p + step, t, edge, ga, gb, normal)
                    offset[0], offset[1], offset[2] = f32(i * edge), f32(j * edge), f32(k * edge)
                    offset[axis] += t * f32(edge)
                    square, along = f32(0), f32(0)
                    for m in range(3):
                        d = offset[m] - middle[m]
                        square += d * d
                        along += d * normal[m]
                        planes[count, m] = normal[m]
                    planes[count, 3] = along
                    planes[count, 4] = np.exp((agreement - f32(1)) / AGREEMENT - square * reach)
                    count += 1
    return count


@scalar
def _meet(planes, count, scale, held, at, A, b, out):
    """Where planes meet, relative to the point of their offsets; those farther than ``scale`` from ``out`` count less.

    Args:
        planes, count: As of ``_near_planes``.
        scale: Lattice steps.
        held, at: (3,) whether a coordinate is held, and where.
        A, b: Work space.
        out: (3,) float32 in and out.

    Returns:
        Sum of the weights.
    """
    A[:] = f32(0)
    b[:] = f32(0)
    total = f32(0)
    by = f32(1) / scale
    for n in range(count):
        plane = planes[n]
        r = (plane[0] * out[0] + plane[1] * out[1] + plane[2] * out[2] - plane[3]) * by
        weight = plane[4] / (f32(1) + r * r)
        _add_plane(A, b, weight, plane, plane[3])
        total += weight
    for m in range(3):
        if held[m]:
            A[0 if m == 0 else (3 if m == 1 else 5)] += FIXED * total
            b[m] += FIXED * total * at[m]
    if total > f32(0):
        _solve(A, b, FEATURE_DAMPING * total, out)
    return total


@scalar
def _feature(field, size, x, y, z, edge, middle, planes, out):
    """Place of a vertex where the planes around meet, relative to the cell; False if there are too few.

    The planes are reweighed by their distance from the vertex, so that one that passes by the cell has no say.

    Args:
        field, size, x, y, z, edge, middle, planes: As of ``_near_planes``.
        out: (3,) float32.
    """
    count = _near_planes(field, size, x, y, z, edge, middle, planes)
    A, b = np.empty(6, f32), np.empty(3, f32)
    held, at = np.zeros(3, np.bool_), np.zeros(3, f32)
    out[0] = out[1] = out[2] = f32(0)
    scale = f32(edge)
    for _ in range(4):
        if _meet(planes, count, scale, held, at, A, b, out) < MIN_PLANES:
            return False
        scale *= f32(0.5)
    for m in range(3):
        at[m] = out[m] + middle[m]
    if _is_empty(field, size, x, y, z, edge, at):
        out[:] = at
        return True
    for _ in range(3):  # within the cell: what lies outside is moved to its nearest face
        worst, most = -1, f32(1e-3) * edge
        for m in range(3):
            beyond = max(-(out[m] + middle[m]), out[m] + middle[m] - edge)
            if beyond > most and not held[m]:
                worst, most = m, beyond
        if worst < 0:
            break
        held[worst] = True
        at[worst] = min(max(out[worst] + middle[worst], f32(0)), f32(edge)) - middle[worst]
        _meet(planes, count, scale, held, at, A, b, out)
    for m in range(3):
        out[m] = min(max(out[m] + middle[m], f32(0)), f32(edge))
    return True


@kernel
def _is_empty(field, size, x, y, z, edge, place):
    """Whether a place lies in a cell beside that at (x, y, z) of which all corners have the same sign: an edge that
    reaches into a cell between its corners, so that no vertex there can lie on it."""
    i, j, k = (
        np.int64(np.floor(place[0] / edge)),
        np.int64(np.floor(place[1] / edge)),
        np.int64(np.floor(place[2] / edge)),
    )
    if max(abs(i), abs(j), abs(k)) != 1:
        return False
    negative = 0
    for m in range(8):
        n = ((x + edge * (i + (m >> 2))) * size + y + edge * (j + ((m >> 1) & 1))) * size + z + edge * (k + (m & 1))
        if np.isnan(field[n]):
            return False
        negative += 1 if field[n] < 0 else 0
    return negative == 0 or negative == 8


@scalar
def place_vertex(field, levels, size, x, y, z, edge, border, top, jump, work, planes, out):
    """Vertex of a cell: place relative to its first point in lattice steps, and normal, into ``out`` (6,).

    In a cell at the border of what is known it is the mean of the crossings that known cells share with it, so that the
    surface ends where the known cells end.

    Returns:
        Whether the surface crosses the cell.
    """
    count = _own_crossings(field, levels, size, x, y, z, edge, border, top, jump, work)
    if count == 0:
        return False
    middle, mean = np.zeros(3, f32), np.zeros(3, f32)
    for n in range(count):
        for i in range(3):
            middle[i] += work[n, i]
            mean[i] += work[n, 3 + i]
    length = np.sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]) + f32(1e-12)
    for i in range(3):
        middle[i] /= f32(count)
        mean[i] /= length
        out[3 + i] = mean[i]
    if border:
        out[:3] = middle
        return True
    A, b = np.zeros(6, f32), np.zeros(3, f32)
    closest = f32(1)
    for n in range(count):
        normal = work[n, 3:6]
        along, cosine = f32(0), f32(0)
        for i in range(3):
            along += (work[n, i] - middle[i]) * normal[i]
            cosine += normal[i] * mean[i]
        closest = min(closest, min(cosine, work[n, 6]))
        _add_plane(A, b, f32(1), normal, along)
    place = out[:3]
    if closest < SMOOTH:
        if not _feature(field, size, x, y, z, edge, middle, planes, place):
            place[:] = middle
        return True
    _solve(A, b, OWN_DAMPING * f32(count), place)
    for i in range(3):
        place[i] = min(max(place[i] + middle[i], f32(0)), f32(edge))
    return True
