"""Loop over guesses of a rigid motion: how much of what is seen each explains."""

from dudmap.kernels.threads import kernel


@kernel
def explained(start, stop, guesses, jacobian, flow, surface, noise, out):
    """Surface that guesses ``start`` to ``stop`` explain, counted as in MSAC (Torr and Zisserman 2000).

    Args:
        start, stop: Range of guesses.
        guesses: (g, 6) float64 twists.
        jacobian: (2, 6, n) float64, change of the pixels of n points by a twist, along u and v.
        flow: (2, n) float64, what it should be, pixels.
        surface: (n,) float64, what each point counts.
        noise: Distance in pixels from which on a point counts nothing.
        out: (g,) float64 out.
    """
    by_square = 1.0 / (noise * noise)
    for g in range(start, stop):
        a, b, c = guesses[g, 0], guesses[g, 1], guesses[g, 2]
        d, e, f = guesses[g, 3], guesses[g, 4], guesses[g, 5]
        total = 0.0
        for n in range(surface.size):
            du = jacobian[0, 0, n] * a + jacobian[0, 1, n] * b + jacobian[0, 2, n] * c
            du += jacobian[0, 3, n] * d + jacobian[0, 4, n] * e + jacobian[0, 5, n] * f - flow[0, n]
            dv = jacobian[1, 0, n] * a + jacobian[1, 1, n] * b + jacobian[1, 2, n] * c
            dv += jacobian[1, 3, n] * d + jacobian[1, 4, n] * e + jacobian[1, 5, n] * f - flow[1, n]
            total += surface[n] * (1.0 - min((du * du + dv * dv) * by_square, 1.0))
        out[g] = total
