"""Rendering of analytic scenes: exact depth, the visible primitive, anti-aliased colour.

A primitive is a kind, half sizes and a rigid pose. With the ray ``(x/z, y/z, 1) * t``, t is the depth, metres, float64.
Boxes, ellipsoids, capsules and cylinders are in closed form; the torus is sphere traced (Hart 1996). Primitives are
binned into tiles, front to back until everything hit is nearer.
"""

import numpy as np

from dudmap.core.backends.threads import compiled

BOX, ELLIPSOID, CAPSULE, CYLINDER, TORUS = range(5)
TILE_WIDTH, TILE_HEIGHT = 32, 16
NEAR = 0.02  # metres; nothing closer is rendered
TEXTURE_SIZE = 512
TEXTURE_LEVELS = 10
_LEVEL_STARTS = np.array([sum((TEXTURE_SIZE >> k) ** 2 for k in range(level)) for level in range(TEXTURE_LEVELS)])

_MATHS = {"nsz", "contract", "reassoc"}


@compiled(fastmath=_MATHS)
def box_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """Entry of the ray o + t d into a box; inf if missed (slab method)."""
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    mx, my, mz = -ox * ix, -oy * iy, -oz * iz
    kx, ky, kz = abs(ix) * hx, abs(iy) * hy, abs(iz) * hz
    near = max(max(mx - kx, my - ky), mz - kz)
    far = min(min(mx + kx, my + ky), mz + kz)
    return near if (near <= far) & (near > NEAR) else np.inf


@compiled(fastmath=_MATHS)
def ellipsoid_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """First hit of an ellipsoid with semi-axes h: a sphere in scaled coordinates."""
    px, py, pz = ox / hx, oy / hy, oz / hz
    qx, qy, qz = dx / hx, dy / hy, dz / hz
    a = qx * qx + qy * qy + qz * qz
    b = (px * qx + py * qy + pz * qz) / a
    cx, cy, cz = px - b * qx, py - b * qy, pz - b * qz  # closest approach to the centre
    rest = 1.0 - (cx * cx + cy * cy + cz * cz)
    t = -b - np.sqrt(max(rest, 0.0) / a)
    return t if (rest >= 0.0) & (t > NEAR) else np.inf


@compiled(fastmath=_MATHS)
def capsule_depth(ox, oy, oz, dx, dy, dz, radius, _, half):
    """First hit of a capsule: all points within ``radius`` of the segment from -half to half on the z axis."""
    squared = radius * radius
    a = dx * dx + dy * dy
    b = (ox * dx + oy * dy) / a
    cx, cy = ox - b * dx, oy - b * dy
    rest = squared - (cx * cx + cy * cy)
    side = -b - np.sqrt(max(rest, 0.0) / a)
    side = side if (rest >= 0.0) & (abs(oz + side * dz) <= half) & (side > NEAR) else np.inf
    length = a + dz * dz
    best = side
    for end in (-half, half):
        pz = oz - end
        e = (ox * dx + oy * dy + pz * dz) / length
        ex, ey, ez = ox - e * dx, oy - e * dy, pz - e * dz
        left = squared - (ex * ex + ey * ey + ez * ez)
        t = -e - np.sqrt(max(left, 0.0) / length)
        t = t if (left >= 0.0) & (t > NEAR) else np.inf
        best = min(best, t)
    return best


@compiled(fastmath=_MATHS)
def cylinder_depth(ox, oy, oz, dx, dy, dz, radius, _, half):
    """First hit of a closed cylinder of the given radius along z, |z| <= half."""
    squared = radius * radius
    a = dx * dx + dy * dy
    b = (ox * dx + oy * dy) / a
    cx, cy = ox - b * dx, oy - b * dy
    rest = squared - (cx * cx + cy * cy)
    side = -b - np.sqrt(max(rest, 0.0) / a)
    side = side if (rest >= 0.0) & (abs(oz + side * dz) <= half) & (side > NEAR) else np.inf
    cap = (-oz - (half if dz > 0 else -half)) / dz
    px, py = ox + cap * dx, oy + cap * dy
    cap = cap if (px * px + py * py <= squared) & (cap > NEAR) else np.inf
    return min(side, cap)


@compiled(fastmath=_MATHS)
def torus_depth(ox, oy, oz, dx, dy, dz, ring, _, tube):
    """First hit of a torus around z by sphere tracing its distance field down to a micrometre."""
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    middle = -(ox * dx + oy * dy + oz * dz) / (length * length)
    reach = (ring + tube) / length
    t = max(middle - reach - 1e-6, NEAR)
    end = middle + reach
    for _ in range(256):
        if t > end:
            return np.inf
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        rho = np.sqrt(x * x + y * y) - ring
        distance = np.sqrt(rho * rho + z * z) - tube
        if distance < 1e-6:
            return t
        t += distance / length
    return t


@compiled(fastmath=_MATHS)
def primitive_depth(kind, ox, oy, oz, dx, dy, dz, hx, hy, hz):
    """Entry depth of the ray o + t d, own frame; inf if missed."""
    if kind == BOX:
        return box_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz)
    if kind == ELLIPSOID:
        return ellipsoid_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz)
    if kind == CAPSULE:
        return capsule_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz)
    if kind == CYLINDER:
        return cylinder_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz)
    return torus_depth(ox, oy, oz, dx, dy, dz, hx, hy, hz)


@compiled(inline="always", fastmath=_MATHS)
def trace_row(depth_of, p, u0, fx, cx, origin, ray, step, half, out):
    """Update one tile line, starting at column u0, at pixels whose nearest hit is primitive p."""
    best, found = out
    for k in range(best.size):
        x = (u0 + k - cx) / fx
        dx, dy, dz = ray[0] + step[0] * x, ray[1] + step[1] * x, ray[2] + step[2] * x
        t = depth_of(origin[0], origin[1], origin[2], dx, dy, dz, half[0], half[1], half[2])
        nearer = t < best[k]
        best[k] = t if nearer else best[k]
        found[k] = np.int16(p) if nearer else found[k]


@compiled(fastmath=_MATHS)
def trace(
    row_from, row_to, order, nearest, in_columns, in_rows, kinds, rotations, origins, halves, intrinsics, depth, ids
):
    """Exact depth and visible primitive of tile rows.

    Args:
        order: (P,) front to back.
        nearest: (P,) their smallest depths.
        in_columns, in_rows: (P, C) and (P, R), touched tile columns and rows.
        kinds: (P,).
        rotations: (P, 3, 3) camera to primitive.
        origins: (P, 3) camera centre in the primitive's frame.
        halves: (P, 3).
        intrinsics: fx fy cx cy.
        depth: Filled, (H, W) float32 metres, 0 = nothing.
        ids: Filled, (H, W) int16, -1 = nothing.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    best = np.empty(TILE_WIDTH * TILE_HEIGHT, np.float64)
    found = np.empty(TILE_WIDTH * TILE_HEIGHT, np.int16)
    for tile_row in range(row_from, row_to):
        v0, v1 = tile_row * TILE_HEIGHT, min((tile_row + 1) * TILE_HEIGHT, height)
        for tile_column in range((width + TILE_WIDTH - 1) // TILE_WIDTH):
            u0, u1 = tile_column * TILE_WIDTH, min((tile_column + 1) * TILE_WIDTH, width)
            count = u1 - u0
            best[:] = np.inf
            found[:] = -1
            farthest = np.inf
            for position in range(order.size):
                p = order[position]
                if nearest[p] > farthest:
                    break
                if not (in_columns[p, tile_column] and in_rows[p, tile_row]):
                    continue
                kind = kinds[p]
                R = rotations[p]
                origin = (origins[p, 0], origins[p, 1], origins[p, 2])
                half = (halves[p, 0], halves[p, 1], halves[p, 2])
                for v in range(v0, v1):
                    y = (v - cy) / fy
                    ray = (R[0, 1] * y + R[0, 2], R[1, 1] * y + R[1, 2], R[2, 1] * y + R[2, 2])
                    step = (R[0, 0], R[1, 0], R[2, 0])
                    line = (v - v0) * TILE_WIDTH
                    out = (best[line : line + count], found[line : line + count])
                    if kind == BOX:
                        trace_row(box_depth, p, u0, fx, cx, origin, ray, step, half, out)
                    elif kind == ELLIPSOID:
                        trace_row(ellipsoid_depth, p, u0, fx, cx, origin, ray, step, half, out)
                    elif kind == CAPSULE:
                        trace_row(capsule_depth, p, u0, fx, cx, origin, ray, step, half, out)
                    elif kind == CYLINDER:
                        trace_row(cylinder_depth, p, u0, fx, cx, origin, ray, step, half, out)
                    else:
                        trace_row(torus_depth, p, u0, fx, cx, origin, ray, step, half, out)
                farthest = 0.0
                for v in range(v1 - v0):
                    for k in range(count):
                        farthest = max(farthest, best[v * TILE_WIDTH + k])
            for v in range(v0, v1):
                for k in range(count):
                    t = best[(v - v0) * TILE_WIDTH + k]
                    depth[v, u0 + k] = np.float32(t) if t < np.inf else np.float32(0.0)
                    ids[v, u0 + k] = found[(v - v0) * TILE_WIDTH + k]


@compiled(inline="always", fastmath=_MATHS)
def surface_normal(kind, x, y, z, hx, hy, hz):
    """Outward unit normal, in the primitive's frame, at a point of its surface."""
    if kind == BOX:
        ax, ay, az = abs(x) - hx, abs(y) - hy, abs(z) - hz
        if ax >= ay and ax >= az:
            return np.sign(x), 0.0, 0.0
        if ay >= az:
            return 0.0, np.sign(y), 0.0
        return 0.0, 0.0, np.sign(z)
    if kind == ELLIPSOID:
        nx, ny, nz = x / (hx * hx), y / (hy * hy), z / (hz * hz)
    elif kind == CAPSULE:
        nx, ny, nz = x, y, z - min(max(z, -hz), hz)
    elif kind == CYLINDER:
        if abs(z) - hz > np.sqrt(x * x + y * y) - hx:
            return 0.0, 0.0, np.sign(z)
        nx, ny, nz = x, y, 0.0
    else:
        rho = np.sqrt(x * x + y * y)
        share = 1.0 - hx / rho
        nx, ny, nz = x * share, y * share, z
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * scale, ny * scale, nz * scale


@compiled(inline="always", fastmath=_MATHS)
def texture_color(atlas, texture, level, u, v):
    """Bilinear look-up in one level of a repeating texture; (red, green, blue) in 0..255."""
    size = TEXTURE_SIZE >> level
    x, y = u * size - 0.5, v * size - 0.5
    left, top = np.floor(x), np.floor(y)
    ax, ay = np.float32(x - left), np.float32(y - top)
    x0, y0 = np.int64(left) & (size - 1), np.int64(top) & (size - 1)
    x1, y1 = (x0 + 1) & (size - 1), (y0 + 1) & (size - 1)
    start = _LEVEL_STARTS[level]
    a, b = atlas[texture, start + y0 * size + x0], atlas[texture, start + y0 * size + x1]
    c, d = atlas[texture, start + y1 * size + x0], atlas[texture, start + y1 * size + x1]
    one = np.float32(1.0)
    w00, w10 = (one - ax) * (one - ay), ax * (one - ay)
    w01, w11 = (one - ax) * ay, ax * ay
    red = w00 * (a & 255) + w10 * (b & 255) + w01 * (c & 255) + w11 * (d & 255)
    green = w00 * (a >> 8 & 255) + w10 * (b >> 8 & 255) + w01 * (c >> 8 & 255) + w11 * (d >> 8 & 255)
    blue = w00 * (a >> 16 & 255) + w10 * (b >> 16 & 255) + w01 * (c >> 16 & 255) + w11 * (d >> 16 & 255)
    return red, green, blue


@compiled(inline="always", fastmath=_MATHS)
def shade_point(p, x, y, t, kinds, rotations, origins, halves, materials, textures, atlas, lights, up, focal):
    """Colour (0..1, three numbers) and cosine of incidence of primitive p at the hit (x, y, 1) t of a ray.

    Textures are projected along the largest normal component, with mip maps, and not mirrored on upright faces. Light:
    Lambert's law, softened, plus a hemisphere. See Renderer for the columns of materials and lights.
    """
    X, Y = x * t, y * t
    px = rotations[p, 0, 0] * X + rotations[p, 0, 1] * Y + rotations[p, 0, 2] * t + origins[p, 0]
    py = rotations[p, 1, 0] * X + rotations[p, 1, 1] * Y + rotations[p, 1, 2] * t + origins[p, 1]
    pz = rotations[p, 2, 0] * X + rotations[p, 2, 1] * Y + rotations[p, 2, 2] * t + origins[p, 2]
    lx, ly, lz = surface_normal(kinds[p], px, py, pz, halves[p, 0], halves[p, 1], halves[p, 2])
    nx = rotations[p, 0, 0] * lx + rotations[p, 1, 0] * ly + rotations[p, 2, 0] * lz
    ny = rotations[p, 0, 1] * lx + rotations[p, 1, 1] * ly + rotations[p, 2, 1] * lz
    nz = rotations[p, 0, 2] * lx + rotations[p, 1, 2] * ly + rotations[p, 2, 2] * lz
    cosine = -(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1.0)

    ax, ay, az = abs(lx), abs(ly), abs(lz)
    if ax >= ay and ax >= az:
        s, w, side = py * np.sign(lx), -pz, 0.37 * np.sign(lx)
    elif ay >= az:
        s, w, side = -px * np.sign(ly), -pz, 0.71 * np.sign(ly)
    else:
        s, w, side = px, -py, 0.0
    u, v = s * materials[p, 0] + materials[p, 2] + side * materials[p, 9], w * materials[p, 1] + materials[p, 3]
    footprint = t / focal * 0.5 * (1.0 + 1.0 / max(cosine, 0.15)) * TEXTURE_SIZE
    level = np.log2(max(footprint * max(materials[p, 0], materials[p, 1]), 1.0))
    level = min(level, TEXTURE_LEVELS - 1.001)
    finer = int(level)
    share = np.float32(level - finer)
    texture = textures[p]
    r0, g0, b0 = texture_color(atlas, texture, finer, u, v)
    r1, g1, b1 = texture_color(atlas, texture, finer + 1, u, v)
    # Texture 0 at a large, incommensurable scale makes repeats of a pattern look different.
    cloud, _, _ = texture_color(atlas, 0, 2, s * 0.233 + materials[p, 3], w * 0.233 + materials[p, 2])
    variation = 1.0 + materials[p, 7] * (cloud - 128.0) * (1.0 / 128.0)

    light = 0.0
    for k in range(lights.shape[0]):
        ex, ey, ez = lights[k, 0] - X, lights[k, 1] - Y, lights[k, 2] - t
        squared = ex * ex + ey * ey + ez * ez
        facing = (ex * nx + ey * ny + ez * nz) / np.sqrt(squared)
        facing = max((facing + lights[k, 5]) / (1.0 + lights[k, 5]), 0.0)
        light += lights[k, 3] * facing / (1.0 + squared * lights[k, 4])
    light += up[3] * (0.75 + 0.25 * (nx * up[0] + ny * up[1] + nz * up[2])) + materials[p, 8]
    gain = light * variation * (1.0 / 255.0)
    return (
        (r0 + share * (r1 - r0)) * materials[p, 4] * gain,
        (g0 + share * (g1 - g0)) * materials[p, 5] * gain,
        (b0 + share * (b1 - b0)) * materials[p, 6] * gain,
        cosine,
    )


@compiled(fastmath=_MATHS)
def shade(
    row_from, row_to, kinds, rotations, origins, halves, intrinsics, depth, ids,
    materials, textures, atlas, lights, up, sky, vignette, gain, color, cosines,
):  # fmt: skip
    """Colour (adds into (H, W, 3) float32, 0..255) and cosine of incidence (H, W) float32 of the tile rows.

    Pixels between two primitives are averaged over 2x2 rays.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    around = np.empty(9, np.int64)
    for tile_row in range(row_from, row_to):
        v0, v1 = tile_row * TILE_HEIGHT, min((tile_row + 1) * TILE_HEIGHT, height)
        for tile_column in range((width + TILE_WIDTH - 1) // TILE_WIDTH):
            u0, u1 = tile_column * TILE_WIDTH, min((tile_column + 1) * TILE_WIDTH, width)
            for v in range(v0, v1):
                for u in range(u0, u1):
                    p = ids[v, u]
                    x, y = (u - cx) / fx, (v - cy) / fy
                    border = (
                        (u > 0 and ids[v, u - 1] != p)
                        or (u + 1 < width and ids[v, u + 1] != p)
                        or (v > 0 and ids[v - 1, u] != p)
                        or (v + 1 < height and ids[v + 1, u] != p)
                    )
                    count = 0
                    if border:  # sub-pixels show the primitives of the neighbouring pixels
                        for k in range(9):
                            vv, uu = v + k // 3 - 1, u + k % 3 - 1
                            if vv < 0 or uu < 0 or vv >= height or uu >= width or ids[vv, uu] < 0:
                                continue
                            known = False
                            for position in range(count):
                                known = known or around[position] == ids[vv, uu]
                            if not known:
                                around[count] = ids[vv, uu]
                                count += 1
                    samples = 4 if border else 1
                    share = 0.25 if border else 1.0
                    red, green, blue, cosine = 0.0, 0.0, 0.0, 1.0
                    for k in range(samples):
                        sx, sy, q, t = x, y, np.int64(p), np.float64(depth[v, u])
                        if border:
                            sx += (0.25 if k & 1 else -0.25) / fx
                            sy += (0.25 if k & 2 else -0.25) / fy
                            t, q = np.inf, -1
                            for position in range(count):
                                c = around[position]
                                hit = primitive_depth(
                                    kinds[c], origins[c, 0], origins[c, 1], origins[c, 2],
                                    rotations[c, 0, 0] * sx + rotations[c, 0, 1] * sy + rotations[c, 0, 2],
                                    rotations[c, 1, 0] * sx + rotations[c, 1, 1] * sy + rotations[c, 1, 2],
                                    rotations[c, 2, 0] * sx + rotations[c, 2, 1] * sy + rotations[c, 2, 2],
                                    halves[c, 0], halves[c, 1], halves[c, 2],
                                )  # fmt: skip
                                if hit < t:
                                    t, q = hit, c
                        r, g, b = sky[0], sky[1], sky[2]
                        if q >= 0:
                            r, g, b, facing = shade_point(
                                q, sx, sy, t, kinds, rotations, origins, halves, materials, textures, atlas, lights,
                                up, fx,
                            )  # fmt: skip
                            if q == p:
                                cosine = facing
                        red, green, blue = red + share * r, green + share * g, blue + share * b
                    scale = gain * 255.0 / (1.0 + vignette * (x * x + y * y))
                    color[v, u, 0] += np.float32(min(red * scale, 255.0 * gain))
                    color[v, u, 1] += np.float32(min(green * scale, 255.0 * gain))
                    color[v, u, 2] += np.float32(min(blue * scale, 255.0 * gain))
                    cosines[v, u] = np.float32(cosine)


@compiled(fastmath=False)
def count_views(first, last, vertices, normals, T, intrinsics, depth, near, far, grazing, counts):
    """Add one to counts[k] for every vertex in [first, last) visible in the depth image (H, W), within the slant of a
    pixel, between near and far (m), at a cosine above grazing.

    vertices, normals (V, 3) float32 world; T (4, 4) world to camera; intrinsics fx fy cx cy.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for k in range(first, last):
        X, Y, Z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
        if not near < z < far:
            continue
        x = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]
        y = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]
        u = int(np.floor(x / z * fx + cx + 0.5))
        v = int(np.floor(y / z * fy + cy + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        cosine = 0.0
        for row in range(3):
            ray = x if row == 0 else y if row == 1 else z
            cosine -= ray * (T[row, 0] * normals[k, 0] + T[row, 1] * normals[k, 1] + T[row, 2] * normals[k, 2])
        cosine /= np.sqrt(x * x + y * y + z * z)
        if cosine <= grazing:
            continue
        tolerance = 0.003 + 0.8 * z / fx * np.sqrt(max(1.0 - cosine * cosine, 0.0)) / cosine
        if abs(depth[v, u] - z) < tolerance:
            counts[k] += 1
