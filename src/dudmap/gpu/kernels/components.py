"""Connected components of label images, in parallel and with the numbers that a scan of the image gives them.

Pixels are linked to neighbours one by one, and a link may hold in one direction only: a flood from p reaches q over the
links p -> q. A scan that floods from each seed not yet reached gives a pixel the first seed, in the order of the
indices, from which it can be reached, since all that this seed reaches was labelled before. Pixels linked both ways
reach each other, so that they are joined first, without repetition, by trees whose root is the least index (Komura
2015; Playne and Hawick 2018); then the first seeds go along the links of one direction until nothing changes. The
results are those of the scan, whatever the order of the threads: minima and sums of integers.
"""

import warp as wp

from dudmap.gpu.kernels.formulas import is_concave, normal_of_gradient, plane_distance
from dudmap.gpu.kernels.structs import Camera
from dudmap.kernels import segmentation

wp.set_module_options({"enable_backward": False})

PLANE_STEP = wp.constant(wp.float32(float(segmentation.PLANE_STEP)))
NODE, SEED = wp.constant(16), wp.constant(32)
"""Bits of a pixel that belongs to the graph, and of one from which a flood begins; bit k is a link to neighbour k."""
NONE = wp.constant(2147483647)
"""First seed of pixels that no flood has reached."""
Image = wp.array2d(dtype=wp.float32)
Bytes = wp.array2d(dtype=wp.uint8)
Labels = wp.array2d(dtype=wp.int32)
Words = wp.array(dtype=wp.int32)


@wp.func
def neighbour(v: int, u: int, k: int, h: int, w: int):
    """Row and column of neighbour k: below, above, right, left; row -1 beyond the image. Opposite are k and k ^ 1."""
    y = v + wp.where(k == 0, 1, 0) - wp.where(k == 1, 1, 0)
    x = u + wp.where(k == 2, 1, 0) - wp.where(k == 3, 1, 0)
    if y >= h or x < 0 or x >= w:
        y = -1
    return y, x


@wp.kernel
def region_links(seeds: Bytes, log_odds: Image, depth: Image, tolerance: Image, links: Bytes):
    """Links of ``labeling.grow_regions`` over pixels whose log odds static : dynamic are below 1."""
    v, u = wp.tid()
    h, w = depth.shape[0], depth.shape[1]
    one, zero = wp.float32(1.0), wp.float32(0.0)
    z = depth[v, u]
    seed = seeds[v, u] != wp.uint8(0)
    bits = int(0)
    if seed or (log_odds[v, u] < one and z > zero):
        bits = NODE
        if seed:
            bits += SEED
        for k in range(4):
            y, x = neighbour(v, u, k, h, w)
            if y >= 0:
                q = depth[y, x]
                if q > zero and (log_odds[y, x] < one or seeds[y, x] != wp.uint8(0)):
                    if abs(q - z) <= tolerance[v, u]:
                        bits += 1 << k
    links[v, u] = wp.uint8(bits)


@wp.func
def surface_end(depth: Image, tolerance: wp.float32, v: int, u: int, dv: int, du: int, reach: int):
    """Pixels (0 to ``reach``) that one can go in a direction without leaving the surface."""
    z = float(depth[v, u])
    end = int(0)
    for step in range(1, reach + 1):
        y, x = v + dv * step, u + du * step
        if end == step - 1 and y >= 0 and x >= 0 and y < depth.shape[0] and x < depth.shape[1]:
            q = depth[y, x]
            if q > wp.float32(0.0) and abs(q - z) <= tolerance:
                z = q
                end = step
    return end


@wp.kernel
def normals_of(depth: Image, camera: Camera, tolerance: Image, reach: int, normals: wp.array2d(dtype=wp.vec3)):
    """Normals, camera frame, towards the camera; 0 = unknown: see ``segmentation.concave_edges``."""
    v, u = wp.tid()
    z, step = depth[v, u], tolerance[v, u]
    normal = wp.vec3()
    if z > wp.float32(0.0):
        left, right = surface_end(depth, step, v, u, 0, -1, reach), surface_end(depth, step, v, u, 0, 1, reach)
        up, down = surface_end(depth, step, v, u, -1, 0, reach), surface_end(depth, step, v, u, 1, 0, reach)
        if left + right > 0 and up + down > 0:
            one = wp.float32(1.0)
            x, y = (wp.float32(u) - camera.cx) * (one / camera.fx), (wp.float32(v) - camera.cy) * (one / camera.fy)
            zu = (depth[v, u + right] - depth[v, u - left]) / wp.float32(left + right) * camera.fx
            zv = (depth[v + down, u] - depth[v - up, u]) / wp.float32(up + down) * camera.fy
            nx, ny, nz = normal_of_gradient(x, y, z, zu, zv)
            normal = wp.vec3(nx, ny, nz)
    normals[v, u] = normal


@wp.func
def between(camera: Camera, v: int, u: int, z: wp.float32, y: int, x: int, q: wp.float32):
    """Vector from the point of a pixel (v, u) at depth z to that of another (y, x) at depth q."""
    ex = ((wp.float32(x) - camera.cx) * q - (wp.float32(u) - camera.cx) * z) / camera.fx
    ey = ((wp.float32(y) - camera.cy) * q - (wp.float32(v) - camera.cy) * z) / camera.fy
    return wp.vec3(ex, ey, q - z)


@wp.kernel
def concave_edges(
    depth: Image, camera: Camera, tolerance: Image, normals: wp.array2d(dtype=wp.vec3), reach: int, sine: wp.float32,
    edge: Bytes,
):  # fmt: skip
    """Pixels on concave edges: see ``segmentation.concave_edges``."""
    v, u = wp.tid()
    zero = wp.float32(0.0)
    z, limit = depth[v, u], wp.float32(reach) * tolerance[v, u]
    found = int(0)
    for k in range(2):
        dv, du = reach * k, reach * (1 - k)
        if z > zero and v >= dv and u >= du and v + dv < depth.shape[0] and u + du < depth.shape[1]:
            za = depth[v - dv, u - du]
            zb = depth[v + dv, u + du]
            a = normals[v - dv, u - du]
            b = normals[v + dv, u + du]
            if za > zero and zb > zero and abs(za - z) <= limit and abs(zb - z) <= limit:
                if a[2] != zero and b[2] != zero:
                    e = between(camera, v - dv, u - du, za, v + dv, u + du, zb)
                    turn = (b[0] - a[0]) * e[0] + (b[1] - a[1]) * e[1] + (b[2] - a[2]) * e[2]
                    if is_concave(turn, wp.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]), sine):
                        found = 1
    edge[v, u] = wp.uint8(found)


@wp.kernel
def surface_links(
    depth: Image, camera: Camera, tolerance: Image, normals: wp.array2d(dtype=wp.vec3), edge: Bytes, links: Bytes
):
    """Links of ``segmentation.connected_segments``: between pixels off the edges; every one is a seed."""
    v, u = wp.tid()
    h, w = depth.shape[0], depth.shape[1]
    zero, nothing = wp.float32(0.0), wp.uint8(0)
    z, step, n = depth[v, u], tolerance[v, u], normals[v, u]
    bits = int(0)
    if z > zero and edge[v, u] == nothing:
        bits = NODE + SEED
        for k in range(4):
            y, x = neighbour(v, u, k, h, w)
            if y >= 0:
                q = depth[y, x]
                if q > zero and edge[y, x] == nothing and abs(q - z) <= step:
                    e = between(camera, v, u, z, y, x, q)
                    m = normals[y, x]
                    here = plane_distance(n[0], n[1], n[2], e[0], e[1], e[2])
                    there = plane_distance(m[0], m[1], m[2], e[0], e[1], e[2])
                    if min(here, there) <= PLANE_STEP * step:
                        bits += 1 << k
    links[v, u] = wp.uint8(bits)


@wp.kernel
def begin(width: int, parent: Words, first: Words, rows: Words, status: Words):
    """Every pixel is a tree of its own; no flood has begun."""
    n = wp.tid()
    parent[n] = n
    first[n] = NONE
    if n % width == 0:
        rows[n / width] = 0
    if n < 2:
        status[n] = 0


@wp.func
def root_of(parent: Words, start: int):
    """Root of a pixel's tree."""
    n = int(start)
    above = parent[n]
    while above != n:
        n = above
        above = parent[n]
    return n


@wp.kernel
def join(links: Bytes, parent: Words):
    """Join the trees of pixels that are linked both ways."""
    v, u = wp.tid()
    h, w = links.shape[0], links.shape[1]
    for turn in range(2):
        k = 2 * turn
        y, x = neighbour(v, u, k, h, w)
        if y >= 0:
            both = (wp.int32(links[v, u]) >> k) & (wp.int32(links[y, x]) >> (k + 1)) & 1
            if both != 0:
                a, b = int(root_of(parent, v * w + u)), int(root_of(parent, y * w + x))
                while a != b:
                    low, high = min(a, b), max(a, b)
                    before = wp.atomic_min(parent, high, low)
                    a = low
                    b = wp.where(before == high, low, root_of(parent, before))


@wp.kernel
def plant(links: Bytes, parent: Words, root: Words, first: Words):
    """Root of each pixel's component, and the first seed in it."""
    v, u = wp.tid()
    n = v * links.shape[1] + u
    r = root_of(parent, n)
    root[n] = r
    if (wp.int32(links[v, u]) & SEED) != 0:
        if n < first[r]:
            wp.atomic_min(first, r, n)


@wp.kernel
def spread(links: Bytes, root: Words, first: Words, last: int, status: Words):
    """Carry first seeds over the links of one direction; the last round says in ``status[0]`` if it changed any."""
    v, u = wp.tid()
    h, w = links.shape[0], links.shape[1]
    bits, r = wp.int32(links[v, u]), root[v * w + u]
    for k in range(4):
        if ((bits >> k) & 1) != 0:
            y, x = neighbour(v, u, k, h, w)
            other = root[y * w + x]
            seed = first[r]
            if seed < first[other]:
                wp.atomic_min(first, other, seed)
                if last != 0:
                    status[0] = 1


@wp.func
def founds(links: Bytes, root: Words, first: Words, v: int, u: int):
    """Whether a pixel is the seed of a component."""
    n = v * links.shape[1] + u
    found = int(0)
    if (wp.int32(links[v, u]) & SEED) != 0:
        if first[root[n]] == n:
            found = 1
    return found


@wp.kernel
def count_rows(links: Bytes, root: Words, first: Words, rows: Words):
    """Number of components whose seed lies in each row."""
    v, u = wp.tid()
    if founds(links, root, first, v, u) == 1:
        wp.atomic_add(rows, v, 1)


@wp.kernel
def number(links: Bytes, root: Words, first: Words, rows: Words, numbers: Words, status: Words):
    """Number of each component, from 1 in the order of the seeds, at its seed; their count is ``status[1]``."""
    v, u = wp.tid()
    w = links.shape[1]
    if founds(links, root, first, v, u) == 1:
        count = int(1)
        for y in range(v):
            count += rows[y]
        for x in range(u):
            count += founds(links, root, first, v, x)
        numbers[v * w + u] = count
        wp.atomic_max(status, 1, count)


@wp.kernel
def label(links: Bytes, root: Words, first: Words, numbers: Words, labels: Labels):
    """Number of each pixel's component; 0 = none."""
    v, u = wp.tid()
    out = int(0)
    if (wp.int32(links[v, u]) & NODE) != 0:
        seed = first[root[v * links.shape[1] + u]]
        if seed < NONE:
            out = numbers[seed]
    labels[v, u] = out


@wp.kernel
def grow(depth: Image, tolerance: Image, labels: Labels, out: Labels):
    """Unlabelled pixels join the neighbour nearest in depth, all at once."""
    v, u = wp.tid()
    z, own = depth[v, u], int(labels[v, u])
    if own == 0 and z > wp.float32(0.0):
        best = float(tolerance[v, u])
        for k in range(4):
            y, x = neighbour(v, u, k, depth.shape[0], depth.shape[1])
            if y >= 0:
                step = abs(depth[y, x] - z)
                if labels[y, x] > 0 and step <= best:
                    best = step
                    own = labels[y, x]
    out[v, u] = own


@wp.kernel
def clear(areas: Words, seeded: Words):
    """No pixels and no seeds."""
    n = wp.tid()
    areas[n] = 0
    seeded[n] = 0


@wp.kernel
def measure(links: Bytes, root: Words, first: Words, areas: Words, seeded: Words):
    """Pixels and seeds of each region, at its first seed."""
    v, u = wp.tid()
    seed = first[root[v * links.shape[1] + u]]
    bits = wp.int32(links[v, u])
    if (bits & NODE) != 0 and seed < NONE:
        wp.atomic_add(areas, seed, 1)
        if (bits & SEED) != 0:
            wp.atomic_add(seeded, seed, 1)


@wp.kernel
def moving(
    links: Bytes, root: Words, first: Words, areas: Words, seeded: Words, min_area: wp.float32, share: wp.float32,
    out: Labels,
):  # fmt: skip
    """1 for pixels of regions that are large enough and have enough seeds, else 0."""
    v, u = wp.tid()
    seed = first[root[v * links.shape[1] + u]]
    found = int(0)
    if (wp.int32(links[v, u]) & NODE) != 0 and seed < NONE:
        area = wp.float32(areas[seed])
        if area >= min_area and wp.float32(seeded[seed]) >= share * area:
            found = 1
    out[v, u] = found


@wp.kernel
def append(status: Words, out: Labels):
    """Write the status below an image, so that both are read at once."""
    n = wp.tid()
    out[out.shape[0] - 1, n] = status[n]
