"""Levenberg-Marquardt steps of a rigid motion (Marquardt 1963): damped step, acceleration, pose update, acceptance."""

import numpy as np

from dudmap.core.backends.threads import scalar
from dudmap.core.geometry.se3 import rodrigues

FLOOR = 1e-9
"""Share of the largest diagonal element always added, for zero steps in unobservable directions."""
FACTOR, LEAST = 5.0, 1e-6
"""Factor of the damping, and its lower bound."""
LONGEST, SHORTEST = 3.0, 0.5
"""Largest and smallest accelerated step, in plain steps."""
SHORT_STEP = 4.0
"""Length, in stop tolerances, of a step that ends a coarse level if the cost hardly changes."""

_rotation = scalar(rodrigues)


@scalar
def damped_step(H, b, basis, damping):
    """Solution (6,) of ``(H + damping diag(H)) step = -b`` in a basis (6, m), H positive semidefinite.

    Unobservable directions get a zero step.
    """
    n, m = basis.shape
    largest = np.float64(0)
    for i in range(n):
        largest = max(largest, H[i, i])
    A, y = np.zeros((m, m)), np.zeros(m)
    for p in range(m):
        for i in range(n):
            y[p] -= basis[i, p] * b[i]
            for q in range(m):
                for j in range(n):
                    added = damping * H[i, i] + FLOOR * largest if i == j else np.float64(0)
                    A[p, q] += basis[i, p] * (H[i, j] + added) * basis[j, q]
    for p in range(m):  # Cholesky factor in the lower triangle, and the forward substitution
        for q in range(p + 1):
            total = A[p, q]
            for k in range(q):
                total -= A[p, k] * A[q, k]
            if q < p:
                A[p, q] = total / A[q, q] if A[q, q] > 0 else np.float64(0)
            else:
                A[p, p] = np.sqrt(total) if total > 0 else np.float64(0)
        for k in range(p):
            y[p] -= A[p, k] * y[k]
        y[p] = y[p] / A[p, p] if A[p, p] > 0 else np.float64(0)
    for p in range(m - 1, -1, -1):
        for k in range(p + 1, m):
            y[p] -= A[k, p] * y[k]
        y[p] = y[p] / A[p, p] if A[p, p] > 0 else np.float64(0)
    step = np.zeros(n)
    for i in range(n):
        for p in range(m):
            step[i] += basis[i, p] * y[p]
    return step


@scalar
def accelerated(step, last, taken):
    """Step (6,) of Anderson's acceleration with one step of memory (Walker and Ni 2011): steps shrink by a common
    factor.

    Args:
        step: Plain step from this pose.
        last: From the previous pose; zeros for none.
        taken: From the previous pose to this one; zeros for none.
    """
    along, squared = np.float64(0), np.float64(0)
    for i in range(6):
        change = step[i] - last[i]
        along, squared = along + step[i] * change, squared + change * change
    theta = min(max(along / squared, 1 - LONGEST), SHORTEST) if squared > 0 else np.float64(0)
    out = np.empty(6)
    for i in range(6):
        out[i] = step[i] - theta * (taken[i] + step[i] - last[i])
    return out


@scalar
def moved(T_world_camera, step):
    """Pose (4, 4) after a twist (v, omega) about the camera's centre, world axes."""
    R = _rotation(step[3], step[4], step[5])
    out = T_world_camera.copy()
    for i in range(3):
        for j in range(3):
            out[i, j] = np.float64(0)
            for k in range(3):
                out[i, j] += R[3 * i + k] * T_world_camera[k, j]
        out[i, 3] += step[i]
    return out


@scalar
def judged(change, cost, length, damping, rules):
    """Whether a trial step is accepted, the next damping, and whether it is the last.

    Args:
        change: Change of the cost by the step.
        cost: Cost before the step.
        length: Metres and radians.
        damping: Damping of this step.
        rules: DescentRules.
    """
    settled = length < SHORT_STEP * rules.stop and abs(change) < rules.stop_gain * cost
    if change < 0:
        return True, max(damping / FACTOR, LEAST), settled
    return False, damping * FACTOR, settled
