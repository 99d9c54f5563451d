"""Dynamic labels (thesis section 4.6, algorithm 3) from the residuals of the first registration."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dudmap.thesis_config import ThesisConfig

Array = NDArray[np.float64]

BINS = 256
"""Bins L of the histogram h(d) (eq. 4.54)."""
NEIGHBOURHOOD = 3
"""Edge of a neighbourhood, pixels: the union of the four maximal cliques (2x2 pixels) that hold a pixel."""
LEAST = 1e-12
"""Smallest variance and probability, which keep logarithms finite."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """Densities of the static and the dynamic class (eq. 4.52, 4.56).

    Attributes:
        P: (2,) prior probabilities of the classes.
        rho: (2,) scales rho_c, square metres.
        likelihood: L(D, U, l) of eq. 4.55.
    """

    P: Array
    rho: Array
    likelihood: float


def density(d: Array, rho: float) -> Array:
    """Half-normal density p(d | l) with scale rho_c (eq. 4.56); 0 below zero."""
    return np.where(d >= 0, 2 / (rho * np.sqrt(2 * np.pi)) * np.exp(-(d**2) / (2 * rho**2)), 0.0)


def neighbourhood_mean(u: Array, known: NDArray[np.bool_]) -> Array:
    """Mean of u (h, w) over the known pixels of each neighbourhood.

    Reading: algorithm 3 connects each pixel to its eight neighbours; its maximal cliques are squares of 2x2 pixels,
    whose union is 3x3.
    """
    size = (NEIGHBOURHOOD, NEIGHBOURHOOD)
    total, count = (
        cv2.boxFilter(image, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for image in (np.where(known, u, 0.0), known.astype(np.float64))
    )
    return np.asarray(total) / np.maximum(np.asarray(count), 1)


def expectation_maximisation(
    r: Array, known: NDArray[np.bool_], u: Array, iterations: int, stop: float
) -> tuple[Array, Mixture]:
    """Posterior u (h, w) of the dynamic class of each pixel, and the mixture (eq. 4.52-4.55, algorithm 3).

    The E-step takes the neighbourhood's mean as prior, the M-step fits the histogram. Reading: algorithm 3 iterates
    "while likelihood increment < threshold"; it ends there.

    Args:
        r: (h, w) residuals (eq. 4.51).
        known: (h, w) bool, pixels with a residual.
        u: (h, w) initial labels.
        iterations: Limit.
        stop: Final relative increment of the likelihood.
    """
    d = r[known]
    edges = np.linspace(0, max(float(d.max()), LEAST), BINS + 1)
    centers, bin_of = (edges[:-1] + edges[1:]) / 2, np.minimum(np.digitize(d, edges) - 1, BINS - 1)
    mixture = _fit(centers, bin_of, u[known])
    for _ in range(iterations):
        P_dynamic = np.clip(neighbourhood_mean(u, known)[known], LEAST, 1 - LEAST)
        static, dynamic = (density(centers, rho)[bin_of] for rho in mixture.rho)
        u = u.copy()  # E-step
        u[known] = P_dynamic * dynamic / np.maximum(P_dynamic * dynamic + (1 - P_dynamic) * static, LEAST)
        before, mixture = mixture, _fit(centers, bin_of, u[known])  # M-step
        if mixture.likelihood - before.likelihood < stop * abs(before.likelihood):
            break
    return u, mixture


def _fit(centers: Array, bin_of: NDArray[np.integer], u: Array) -> Mixture:
    weights = np.stack([1 - u, u])
    h = np.stack([np.bincount(bin_of, weight, BINS) for weight in weights])  # h(d) u_i(d)
    total = np.maximum(h.sum(axis=1), LEAST)
    P = np.clip(total / total.sum(), LEAST, 1)
    rho = np.sqrt(np.maximum((h @ centers**2) / total, LEAST))
    log_density = np.stack([np.log(np.maximum(P[i] * density(centers, rho[i]), LEAST)) for i in range(2)])
    return Mixture(P, rho, float((h * log_density).sum()))


def per_voxel(dynamic: NDArray[np.bool_], known: NDArray[np.bool_], X: Array, tau: float) -> NDArray[np.bool_]:
    """Labels (h, w) of the label grid: the majority of each voxel's pixels.

    Args:
        dynamic, known: (h, w) bool.
        X: (h, w, 3) points, world, metres.
        tau: Voxel size, metres.
    """
    index = np.floor(X[known] / tau).astype(np.int64)
    index -= index.min(axis=0)
    size = index.max(axis=0) + 1
    _, voxel = np.unique((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], return_inverse=True)
    share = np.bincount(voxel, dynamic[known]) / np.maximum(np.bincount(voxel), 1)
    out = np.zeros_like(dynamic)
    out[known] = share[voxel] > 0.5
    return out


def dynamic_labels(psi: NDArray[np.float32], X: Array, config: ThesisConfig) -> tuple[NDArray[np.bool_], Array]:
    """Dynamic pixels (h, w), and the posterior of the dynamic class (algorithm 3, eq. 4.50-4.57).

    Initially, delta_L to the static map exceeds theta. Reading: the new observation has the distance 0 at its points,
    so that delta_L is |psi|; off the map is static.

    Args:
        psi: (h, w) distances after the first registration, metres; NaN off the map.
        X: (h, w, 3) points, world, metres.
        config: theta, tau and the EM.
    """
    known = np.isfinite(psi)
    distance = np.where(known, np.abs(psi), 0).astype(np.float64)
    off = known & (distance > config.theta)  # eq. 4.57
    if not off.any():
        return off, np.zeros(psi.shape)
    r = distance**2  # eq. 4.51
    u, _ = expectation_maximisation(r, known, off.astype(np.float64), config.em_iterations, config.em_stop)
    return per_voxel((u > 0.5) & off, known, X, config.tau), u
