"""Loops over what is seen: how much of it a rigid motion explains, and the step to a better one."""

import numpy as np

from dudmap.kernels.threads import kernel


@kernel
def msac_scores(start, stop, guesses, jacobian, flow, usual, surface, noise, near, out):
    """Surface that guesses ``start`` to ``stop`` explain, counted as in MSAC (Torr and Zisserman 2000), by how likely.

    Args:
        start, stop: Range of guesses.
        guesses: (g, 6) float64 twists.
        jacobian: (2, 6, n) float64, change of the pixels of n points by a twist, along u and v.
        flow: (2, n) float64, what it was, pixels.
        usual: (2, n) float64, what was expected of it, pixels.
        surface: (n,) float64, what each point counts.
        noise: Distance in pixels from which on a point counts nothing.
        near: Mean distance in pixels from what was expected at which a guess is less likely by a quarter; by a half
            at most.
        out: (g,) float64 out.
    """
    by_square = 1.0 / (noise * noise)
    for g in range(start, stop):
        a, b, c = guesses[g, 0], guesses[g, 1], guesses[g, 2]
        d, e, f = guesses[g, 3], guesses[g, 4], guesses[g, 5]
        total, away = 0.0, 0.0
        for n in range(surface.size):
            u = jacobian[0, 0, n] * a + jacobian[0, 1, n] * b + jacobian[0, 2, n] * c
            u += jacobian[0, 3, n] * d + jacobian[0, 4, n] * e + jacobian[0, 5, n] * f
            v = jacobian[1, 0, n] * a + jacobian[1, 1, n] * b + jacobian[1, 2, n] * c
            v += jacobian[1, 3, n] * d + jacobian[1, 4, n] * e + jacobian[1, 5, n] * f
            du, dv = u - flow[0, n], v - flow[1, n]
            total += surface[n] * (1.0 - min((du * du + dv * dv) * by_square, 1.0))
            du, dv = u - usual[0, n], v - usual[1, n]
            away += np.sqrt(du * du + dv * dv)
        away /= near * surface.size
        out[g] = total * (0.5 + 0.5 / (1.0 + away * away))


@kernel
def refinement(points, targets, say, T, intrinsics, limit, H, gradient):
    """Normal equations of the step that makes a motion explain better what it explains already.

    Args:
        points: (n, 3) float64, metres, first camera's frame.
        targets: (n, 2) float64, their pixels in the second image.
        say: (n,) float64, what each of them counts.
        T: (4, 4) float64, the motion.
        intrinsics: (4,) fx, fy, cx, cy.
        limit: Distance in pixels from which on a point has no say.
        H: (6, 6) float64 out, by twists (v, omega) from the left.
        gradient: (6,) float64 out; the step is ``solve(H, gradient)``.

    Returns:
        How many points that is.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    H[:] = 0.0
    gradient[:] = 0.0
    count = 0
    for n in range(points.shape[0]):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        z = max(T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3], 1e-6)
        x = (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]) / z
        y = (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]) / z
        du, dv = targets[n, 0] - fx * x - cx, targets[n, 1] - fy * y - cy
        if not du * du + dv * dv < limit * limit:
            continue
        count += 1
        along_u = (fx / z, 0.0, -fx * x / z, -fx * x * y, fx * (1.0 + x * x), -fx * y)
        along_v = (0.0, fy / z, -fy * y / z, -fy * (1.0 + y * y), fy * x * y, fy * x)
        for i in range(6):
            gradient[i] += say[n] * (along_u[i] * du + along_v[i] * dv)
            for j in range(6):
                H[i, j] += say[n] * (along_u[i] * along_u[j] + along_v[i] * along_v[j])
    return count
