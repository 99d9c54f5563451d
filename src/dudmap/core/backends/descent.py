"""Levenberg-Marquardt descent of a registration on one pyramid level (Marquardt 1963)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import NormalEquations
from dudmap.core.formulas.damping import accelerated, damped_step, judged, moved


class DescentRules(NamedTuple):
    """Start and stop rules.

    Attributes:
        basis: (6, m) directions of allowed twists.
        damping: First one, relative to the diagonal of H.
        max_steps: Trial steps.
        stop: Norm of the last step (m, rad).
        stop_gain: Relative cost change below which a short step is the last.
    """

    basis: NDArray[np.float64]
    damping: float
    max_steps: int
    stop: float
    stop_gain: float


class Descent(NamedTuple):
    """Result of a descent.

    Attributes:
        T_world_camera: (4, 4) the last accepted pose.
        equations: Of the last accepted step, or the first ones.
        iterations: Linearisations.
        converged: Whether a stop criterion was met.
    """

    T_world_camera: NDArray[np.float64]
    equations: NormalEquations
    iterations: int
    converged: bool


def descend(
    linearize: Callable[[NDArray[np.float64]], NormalEquations],
    T_world_camera: NDArray[np.float64],
    first: NormalEquations | None,
    rules: DescentRules,
) -> Descent:
    """Accelerated Levenberg-Marquardt steps; a step must decrease the cost, by the mean gradient (trapezoidal rule),
    because pixels that enter or leave the map change costs more.

    The CPU has the same loop in ``cpu/registration.py``.

    Args:
        linearize: Returns the normal equations at a pose (4, 4).
        T_world_camera: (4, 4) first pose.
        first: Normal equations at the first pose; None if unknown.
        rules: Start and stop rules.
    """
    T, damping, used = T_world_camera, rules.damping, int(first is None)
    system, last, taken = linearize(T) if first is None else first, np.zeros(6), np.zeros(6)
    for _ in range(rules.max_steps):
        if not np.diag(system.H).max() > 0:
            break
        plain = damped_step(system.H, system.b, rules.basis, damping)
        step = accelerated(plain, last, taken) if taken.any() else plain
        T_trial, length = moved(T, step), float(np.linalg.norm(step))
        if length < rules.stop:  # too short to need another linearisation
            return Descent(T_trial, system, used, converged=True)
        trial = linearize(T_trial)
        used += 1
        change = float((system.b + trial.b) @ step) / 2
        accepted, damping, converged = judged(change, system.cost, length, damping, rules)
        if accepted:
            T, system = T_trial, trial
        last, taken = plain, step if accepted else np.zeros(6)
        if converged:
            return Descent(T, system, used, converged=True)
    return Descent(T, system, used, converged=False)
