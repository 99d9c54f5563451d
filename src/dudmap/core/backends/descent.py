"""Levenberg-Marquardt steps of a registration on one level of the pyramid (Marquardt 1963), for every back end."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.parameters import NormalEquations
from dudmap.core.geometry import se3

SHORT_STEP = 4.0
"""A step shorter than this multiple of the stop tolerance ends a coarse level if the cost hardly changes, and is taken
on the finest level whatever it costs."""
FLOOR = 1e-9
"""Share of the largest diagonal element that is always added, so that a direction without information stays still."""
FACTOR, LEAST = 5.0, 1e-6
"""The damping grows and shrinks by this factor, down to the least one."""


class DescentRules(NamedTuple):
    """How the steps of a registration begin, and when they end.

    Attributes:
        basis: (6, m) directions of a twist along which the pose may move.
        damping: First damping, relative to the diagonal of H.
        limit: Largest number of steps that are tried.
        stop: Norm of a step (m, rad) below which it is the last one.
        stop_gain: Relative change of the cost below which a short step is.
        taken: Norm of a step below which it is made whatever it costs.
    """

    basis: NDArray[np.float64]
    damping: float
    limit: int
    stop: float
    stop_gain: float
    taken: float


class Descent(NamedTuple):
    """Result of the steps of a registration.

    Attributes:
        T_world_camera: (4, 4) the last accepted pose.
        equations: Normal equations of the last accepted step; the first ones where none was.
        iterations: Number of linearisations.
        settled: Whether a stop criterion was met.
    """

    T_world_camera: NDArray[np.float64]
    equations: NormalEquations
    iterations: int
    settled: bool


def descend(
    linearize: Callable[[NDArray[np.float64]], NormalEquations],
    T_world_camera: NDArray[np.float64],
    first: NormalEquations,
    rules: DescentRules,
) -> Descent:
    """Steps whose damping is scaled by the diagonal of H; one is accepted if it decreases the cost.

    Args:
        linearize: Gives the normal equations at a pose (4, 4).
        T_world_camera: (4, 4) first pose.
        first: Normal equations there.
        rules: Beginning and end.
    """
    T, system, damping, used = T_world_camera, first, rules.damping, 0
    for _ in range(rules.limit):
        diagonal = np.diag(system.H)
        if not diagonal.max() > 0:
            break
        damped = system.H + np.diag(damping * diagonal + FLOOR * diagonal.max())
        step = restricted_step(damped, system.b, rules.basis)
        T_trial, length = se3.retract(T, step), np.linalg.norm(step)
        if length < rules.stop:  # too short to need another linearisation
            return Descent(T_trial, system, used, settled=True)
        trial = linearize(T_trial)
        used += 1
        gain = abs(trial.cost - system.cost)
        settled = bool(length < SHORT_STEP * rules.stop and gain < rules.stop_gain * system.cost)
        if trial.cost < system.cost or length < rules.taken:
            T, system, damping = T_trial, trial, max(damping / FACTOR, LEAST)
        else:
            damping *= FACTOR
        if settled:
            return Descent(T, system, used, settled=True)
    return Descent(T, system, used, settled=False)


def restricted_step(H: NDArray[np.float64], b: NDArray[np.float64], basis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution (6,) of ``H step = -b`` that moves along the directions of a basis (6, m) only."""
    if basis.shape[1] == len(b):
        return np.asarray(-np.linalg.solve(H, b), dtype=np.float64)
    return basis @ np.linalg.solve(basis.T @ H @ basis, -basis.T @ b)
