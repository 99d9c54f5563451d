"""Simulation of a depth and colour sensor: noise, quantisation, occlusion shadows, missing depth."""

import numpy as np

from dudmap.core.backends.threads import compiled


@compiled(fastmath=False)
def _mix(a, b, key):
    """Hash of two integers and a key, 64 bits (splitmix64 finaliser)."""
    x = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(key)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@compiled(fastmath=False)
def measure_depth(row_from, row_to, exact, cosines, smooth, offsets, key, focal, model, depth):
    """Depth measured by a disparity sensor in the rows [row_from, row_to); ``model`` is ``sensors.SensorModel.row``.

    exact, cosines (H, W) float32; smooth (S, S) float32 periodic noise of unit variance, S a power of two; offsets (4,
    2) into it; key uint64; depth (H, W) float32 output, 0 = missing.
    """
    height, width = exact.shape
    wrap = smooth.shape[0] - 1
    baseline, sigma, step, lateral = model[0], model[1], model[2], model[3]
    nearest, fade, farthest = model[4], model[5], model[6]
    fatten, grazing, edge_loss, speckle = int(model[7]), model[8], model[9], model[10]
    scale = focal * baseline
    seen = np.empty(width, np.float32)
    lit = np.empty(2 * width + 2, np.float32)
    for v in range(row_from, row_to):
        for u in range(width):
            # Lateral noise: the measurement belongs to a ray shifted by a fraction of a pixel.
            a = smooth[(v + offsets[0, 0]) & wrap, (u + offsets[0, 1]) & wrap]
            b = smooth[(v + offsets[1, 0]) & wrap, (u + offsets[1, 1]) & wrap]
            x = min(max(int(np.floor(u + lateral * a + 0.5)), 0), width - 1)
            y = min(max(int(np.floor(v + lateral * b + 0.5)), 0), height - 1)
            z = exact[y, x]
            if fatten > 0:  # foreground fattening of window matching
                for k in range(-fatten, fatten + 1):
                    other = exact[y, min(max(x + k, 0), width - 1)]
                    if other > 0 and (z == 0 or other < z):
                        z = other
            seen[u] = z
        # A point is lit (or seen by the second camera) if no nearer point lies on the ray of the projector, which
        # is one baseline to the right: its image is shifted to the left by the disparity.
        lit[:] = 0
        for u in range(width):
            if seen[u] > 0:
                disparity = np.float32(scale / seen[u])
                column = int(np.floor(u - disparity)) + width
                if column >= 0:
                    lit[column] = max(lit[column], disparity)
                    lit[column + 1] = max(lit[column + 1], disparity)
        for u in range(width):
            z = seen[u]
            depth[v, u] = 0
            if not nearest <= z <= farthest:
                continue
            disparity = np.float32(scale / z)
            column = int(np.floor(u - disparity + 0.5)) + width
            if column >= 0 and lit[column] > disparity * np.float32(1.02) + np.float32(0.4):
                continue
            bits = _mix(v, u, key)
            chance = np.float32(bits & np.uint64(0xFFFF)) / np.float32(65536.0)
            other_chance = np.float32((bits >> np.uint64(16)) & np.uint64(0xFFFF)) / np.float32(65536.0)
            lost = np.float32(speckle)
            if z > fade:
                lost += np.float32((z - fade) / (farthest - fade)) ** 2
            jump = np.float32(0.0)
            for k in range(4):
                uu = min(max(u + (2 if k == 0 else -2 if k == 1 else 0), 0), width - 1)
                vv = min(max(v + (2 if k == 2 else -2 if k == 3 else 0), 0), height - 1)
                other = exact[vv, uu]
                jump = max(jump, z - other if other > 0 else np.float32(1.0))
            if jump > 0.04 * z + 0.02:
                lost += np.float32(edge_loss)
            cosine = cosines[v, u]
            if cosine < grazing:
                lost += np.float32(1.5 * (grazing - cosine) / grazing)
            if chance < lost:
                continue
            c = smooth[(v + offsets[2, 0]) & wrap, (u + offsets[2, 1]) & wrap]
            d = smooth[(v + offsets[3, 0]) & wrap, (wrap - u + offsets[3, 1]) & wrap]
            white = np.float32(np.sqrt(12.0)) * (other_chance - np.float32(0.5))
            noisy = disparity + sigma * (0.65 * (c + d) + 0.394 * white)
            if step > 0:
                noisy = np.floor(noisy / step + 0.5) * step
            reading = scale / noisy if noisy > 0 else 0.0
            if nearest <= reading <= farthest:
                depth[v, u] = np.float32(reading)


@compiled(fastmath=False)
def measure_color(row_from, row_to, exact, table, key, sigma, color):
    """Add ``sigma`` grey values of noise to exact (H, W, 3) float32 into color (H, W, 3) uint8.

    table (65536,) float32: unit Gaussian samples.
    """
    height, width, _ = exact.shape
    for v in range(row_from, row_to):
        for u in range(width):
            bits = _mix(v + height, u, key)
            for channel in range(3):
                noise = table[(bits >> np.uint64(16 * channel)) & np.uint64(0xFFFF)]
                value = exact[v, u, channel] + sigma * noise + np.float32(0.5)
                color[v, u, channel] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))


@compiled(fastmath=False)
def measure_range(row_from, row_to, exact, cosines, smooth, offsets, key, model, depth):
    """Depth measured by a time-of-flight sensor; ``model`` is ``sensors.TimeOfFlightModel.row``.

    Arguments as of ``measure_depth``. The standard deviation is (s0 + s1 z + s2 z^2) plus s_angle z^1.5 (theta / (pi/2
    - theta))^2.
    """
    height, width = exact.shape
    wrap = smooth.shape[0] - 1
    s0, s1, s2, s_angle, lateral = model[0], model[1], model[2], model[3], model[4]
    nearest, fade, farthest = model[5], model[6], model[7]
    grazing, edge_loss, speckle = model[8], model[9], model[10]
    for v in range(row_from, row_to):
        for u in range(width):
            depth[v, u] = 0
            a = smooth[(v + offsets[0, 0]) & wrap, (u + offsets[0, 1]) & wrap]
            b = smooth[(v + offsets[1, 0]) & wrap, (u + offsets[1, 1]) & wrap]
            x = min(max(int(np.floor(u + lateral * a + 0.5)), 0), width - 1)
            y = min(max(int(np.floor(v + lateral * b + 0.5)), 0), height - 1)
            z = exact[y, x]
            if not nearest <= z <= farthest:
                continue
            bits = _mix(v, u, key)
            chance = np.float32(bits & np.uint64(0xFFFF)) / np.float32(65536.0)
            other_chance = np.float32((bits >> np.uint64(16)) & np.uint64(0xFFFF)) / np.float32(65536.0)
            lost = np.float32(speckle)
            if z > fade:
                lost += np.float32((z - fade) / (farthest - fade)) ** 2
            jump = np.float32(0.0)
            for k in range(4):
                uu = min(max(u + (1 if k == 0 else -1 if k == 1 else 0), 0), width - 1)
                vv = min(max(v + (1 if k == 2 else -1 if k == 3 else 0), 0), height - 1)
                jump = max(jump, abs(z - exact[vv, uu]))
            if jump > 0.04 * z + 0.02:
                lost += np.float32(edge_loss)
            cosine = cosines[y, x]
            if cosine < grazing:
                lost += np.float32(1.5 * (grazing - cosine) / grazing)
            if chance < lost:
                continue
            theta = np.arccos(min(max(cosine, np.float32(0.05)), np.float32(1.0)))
            slant = theta / (0.5 * np.pi - theta)
            sigma = s0 + z * (s1 + z * s2) + s_angle * z * np.sqrt(z) * slant * slant
            c = smooth[(v + offsets[2, 0]) & wrap, (u + offsets[2, 1]) & wrap]
            d = smooth[(v + offsets[3, 0]) & wrap, (wrap - u + offsets[3, 1]) & wrap]
            white = np.float32(np.sqrt(12.0)) * (other_chance - np.float32(0.5))
            reading = z + sigma * (0.65 * (c + d) + 0.394 * white)
            if nearest <= reading <= farthest:
                depth[v, u] = np.float32(reading)
