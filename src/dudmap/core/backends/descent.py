"""Levenberg-Marquardt descent of a registration on one pyramid level (Marquardt 1963)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import NormalEquations
from dudmap.core.formulas.damping import accelerated, damped_step, judged, moved


class DescentRules(NamedTuple):
    """Start and stop rules of a descent.

    Attributes:
        basis: (6, m) directions of a twist along which the pose may move.
        damping: First damping, relative to the diagonal of H.
        max_steps: Largest number of trial steps.
        stop: Norm of a step (m, rad) below which it is the last one.
        stop_gain: Relative change of the cost below which a short step is the last one.
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
        equations: Normal equations of the last accepted step; the first ones if no step was accepted.
        iterations: Number of linearisations.
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
    """Accelerated Levenberg-Marquardt steps; a step is accepted if it decreases the cost.

    The change is estimated from the mean of the gradients before and after the step (trapezoidal rule). Pixels that
    enter or leave the map change the costs more than short steps do. The CPU has the same loop as one compiled call
    (``cpu/registration.py``).

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
