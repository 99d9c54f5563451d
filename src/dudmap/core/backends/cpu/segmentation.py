"""Surface segmentation along depth edges and concave edges."""

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.threads import kernel, scalar

PLANE_STEP = np.float32(0.35)
"""Distance of a pixel from its neighbour's plane, share of the largest depth step."""


def segment_surface(
    depth: NDArray[np.float32],
    intrinsics: NDArray[np.float32],
    tolerance: NDArray[np.float32],
    reach: int,
    normal_reach: int,
    sine: float,
) -> tuple[NDArray[np.int32], int]:
    """Connected segments of surface between depth edges and concave edges.

    Args:
        depth: (h, w) float32, metres, 0 = none.
        intrinsics: (4,) float32 fx, fy, cx, cy.
        tolerance: (h, w) float32, largest depth step within a surface, metres.
        reach: Pixels from a concave edge to the compared normals.
        normal_reach: Half width of a normal's window, pixels.
        sine: Of half the smallest angle across a concave edge.

    Returns:
        (h, w) int32 segment from 1, 0 = no depth, and their number.
    """
    normals = np.empty((*depth.shape, 3), dtype=np.float32)
    edge = np.empty(depth.shape, dtype=np.bool_)
    labels = np.empty(depth.shape, dtype=np.int32)
    concave_edges(depth, intrinsics, tolerance, reach, normal_reach, np.float32(sine), normals, edge)
    count = connected_segments(depth, intrinsics, tolerance, normals, edge, labels, reach + 1)
    return labels, count


@scalar
def surface_end(depth, tolerance, v, u, dv, du, reach):
    """Pixels (0 to ``reach``) on the same surface in a direction."""
    z = depth[v, u]
    for step in range(1, reach + 1):
        vn, un = v + dv * step, u + du * step
        if vn < 0 or un < 0 or vn >= depth.shape[0] or un >= depth.shape[1]:
            return step - 1
        if depth[vn, un] <= 0 or abs(depth[vn, un] - z) > tolerance[v, u]:
            return step - 1
        z = depth[vn, un]
    return reach


@scalar
def normal_of_gradient(x, y, z, zu, zv):
    """Unit normal, towards the camera, at normalised (x, y) and depth z with gradient (zu, zv)."""
    nx, ny, nz = zu, zv, -(z + x * zu + y * zv)
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@scalar
def is_concave(turn, length, sine):
    """Whether two points lie on either side of a concave edge.

    Args:
        turn: (n_b - n_a) . (b - a) of points and unit normals: negative across a concave edge (Stein et al. 2014).
        length: |b - a|.
        sine: Of half the smallest angle.
    """
    return turn < -np.float32(2) * sine * length


@scalar
def plane_distance(nx, ny, nz, ex, ey, ez):
    """Distance of a point e, relative to a plane's point, from the plane with unit normal n."""
    return abs(nx * ex + ny * ey + nz * ez)


@scalar
def plane_step(depth, intrinsics, normals, v, u, vn, un):
    """Smaller distance of two neighbours from each other's plane, metres."""
    z, zn = depth[v, u], depth[vn, un]
    ex = ((np.float32(un) - intrinsics[2]) * zn - (np.float32(u) - intrinsics[2]) * z) / intrinsics[0]
    ey = ((np.float32(vn) - intrinsics[3]) * zn - (np.float32(v) - intrinsics[3]) * z) / intrinsics[1]
    ez = zn - z
    a = plane_distance(normals[v, u, 0], normals[v, u, 1], normals[v, u, 2], ex, ey, ez)
    b = plane_distance(normals[vn, un, 0], normals[vn, un, 1], normals[vn, un, 2], ex, ey, ez)
    return min(a, b)


@kernel
def concave_edges(depth, intrinsics, tolerance, reach, normal_reach, sine, normals, edge):
    """Normals, and pixels on concave edges, which separate an object from the floor.

    Args:
        depth, intrinsics, tolerance, reach, normal_reach, sine: See ``segment_surface``.
        normals: (h, w, 3) float32 out, camera frame, towards the camera; 0 = unknown.
        edge: (h, w) bool out.
    """
    h, w = depth.shape
    normals[:] = 0
    by_x, by_y = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    for v in range(h):
        y = (np.float32(v) - intrinsics[3]) * by_y
        for u in range(w):
            z = depth[v, u]
            if z <= 0:
                continue
            left = surface_end(depth, tolerance, v, u, 0, -1, normal_reach)
            right = surface_end(depth, tolerance, v, u, 0, 1, normal_reach)
            up = surface_end(depth, tolerance, v, u, -1, 0, normal_reach)
            down = surface_end(depth, tolerance, v, u, 1, 0, normal_reach)
            if left + right == 0 or up + down == 0:
                continue
            x = (np.float32(u) - intrinsics[2]) * by_x
            zu = (depth[v, u + right] - depth[v, u - left]) / np.float32(left + right) * intrinsics[0]
            zv = (depth[v + down, u] - depth[v - up, u]) / np.float32(up + down) * intrinsics[1]
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = normal_of_gradient(x, y, z, zu, zv)
    for v in range(h):
        for u in range(w):
            edge[v, u] = False
            for k in range(2):
                dv, du = reach * k, reach * (1 - k)
                va, ua, vb, ub = v - dv, u - du, v + dv, u + du
                if va < 0 or ua < 0 or vb >= h or ub >= w:
                    continue
                za, zb, z = depth[va, ua], depth[vb, ub], depth[v, u]
                limit = np.float32(reach) * tolerance[v, u]
                if za <= 0 or zb <= 0 or z <= 0 or abs(za - z) > limit or abs(zb - z) > limit:
                    continue
                if normals[va, ua, 2] == 0 or normals[vb, ub, 2] == 0:
                    continue
                ex = ((np.float32(ub) - intrinsics[2]) * zb - (np.float32(ua) - intrinsics[2]) * za) * by_x
                ey = ((np.float32(vb) - intrinsics[3]) * zb - (np.float32(va) - intrinsics[3]) * za) * by_y
                ez = zb - za
                turn = (
                    (normals[vb, ub, 0] - normals[va, ua, 0]) * ex
                    + (normals[vb, ub, 1] - normals[va, ua, 1]) * ey
                    + (normals[vb, ub, 2] - normals[va, ua, 2]) * ez
                )
                if is_concave(turn, np.sqrt(ex * ex + ey * ey + ez * ez), sine):
                    edge[v, u] = True


@kernel
def connected_segments(depth, intrinsics, tolerance, normals, edge, labels, passes):
    """Connected components; pixels on a concave edge join the neighbour nearest in depth.

    Args:
        depth, intrinsics, tolerance, normals, edge: See ``concave_edges``.
        labels: (h, w) int32 out, from 1, 0 = no depth.
        passes: Pixels by which segments grow over an edge.

    Returns:
        Number of segments.
    """
    h, w = depth.shape
    stack = np.empty(h * w, np.int32)
    labels[:] = 0
    count = 0
    for v0 in range(h):
        for u0 in range(w):
            if labels[v0, u0] != 0 or edge[v0, u0] or depth[v0, u0] <= 0:
                continue
            count += 1
            labels[v0, u0] = count
            stack[0] = v0 * w + u0
            top = 1
            while top > 0:
                top -= 1
                v, u = stack[top] // w, stack[top] % w
                z = depth[v, u]
                for k in range(4):
                    vn = v + (1 if k == 0 else -1 if k == 1 else 0)
                    un = u + (1 if k == 2 else -1 if k == 3 else 0)
                    if vn < 0 or un < 0 or vn >= h or un >= w or labels[vn, un] != 0:
                        continue
                    if edge[vn, un] or depth[vn, un] <= 0 or abs(depth[vn, un] - z) > tolerance[v, u]:
                        continue
                    if plane_step(depth, intrinsics, normals, v, u, vn, un) > PLANE_STEP * tolerance[v, u]:
                        continue
                    labels[vn, un] = count
                    stack[top] = vn * w + un
                    top += 1
    for _ in range(passes):
        # pixels join simultaneously, so that the result does not depend on the scan order
        for v in range(h):
            for u in range(w):
                if labels[v, u] != 0 or depth[v, u] <= 0:
                    continue
                best, owner = tolerance[v, u], 0
                for k in range(4):
                    vn = v + (1 if k == 0 else -1 if k == 1 else 0)
                    un = u + (1 if k == 2 else -1 if k == 3 else 0)
                    if vn < 0 or un < 0 or vn >= h or un >= w or labels[vn, un] <= 0:
                        continue
                    step = abs(depth[vn, un] - depth[v, u])
                    if step <= best:
                        best, owner = step, labels[vn, un]
                labels[v, u] = -owner
        for v in range(h):
            for u in range(w):
                labels[v, u] = abs(labels[v, u])
    return count
