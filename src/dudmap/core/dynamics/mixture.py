"""Mixture of two half-normal densities of the normalised residual (thesis section 4.6, eq. 4.52-4.56)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dudmap.core.backends.cpu import labeling
from dudmap.core.backends.cpu.evidence import MAX_RESIDUAL, MixtureRules, mixture_log_odds

START = 0.1, 1.0, 6.0
"""Prior of the dynamic density and standard deviations, static and dynamic, from which the EM starts."""
PRIOR_BOUNDS = 0.02, 0.98
"""Bounds of the prior of the dynamic density; they keep its logarithm finite."""
STATIC_BOUNDS = 0.5, 2.0
"""Bounds of the standard deviation of the static density, which is 1 where the sensor model is exact."""
SEPARATION = 3.0
"""Least ratio of the standard deviations, dynamic : static, so that the components cannot swap."""

RULES = MixtureRules(30, START, PRIOR_BOUNDS, STATIC_BOUNDS, SEPARATION)
"""Rules of the fit of a frame."""


@dataclass(frozen=True)
class Mixture:
    """Two half-normal densities of the normalised residual (eq. 4.52, 4.56), static and dynamic.

    Attributes:
        prior: Prior probabilities of both components.
        sigma: Their standard deviations.
    """

    prior: tuple[float, float]
    sigma: tuple[float, float]

    @property
    def coefficients(self) -> tuple[float, float]:
        """Offset and slope of the log odds static : dynamic over the squared normalised residual."""
        (p_static, p_dynamic), (s, d) = self.prior, self.sigma
        return np.log(p_static / p_dynamic * d / s), 0.5 / d**2 - 0.5 / s**2

    def log_odds(self, residual: NDArray[np.floating]) -> NDArray[np.float32]:
        """Log odds static : dynamic of normalised residuals >= 0."""
        offset, slope = self.coefficients
        return mixture_log_odds.py_func(np.square(residual, dtype=np.float32), offset, np.float32(slope))

    def density(self, residual: NDArray[np.floating]) -> NDArray[np.float64]:
        """Densities (2, ...) of both components, priors included."""
        r = np.asarray(residual, dtype=np.float64)
        return np.stack(
            [
                p * np.sqrt(2 / np.pi) / s * np.exp(-0.5 * (r / s) ** 2)
                for p, s in zip(self.prior, self.sigma, strict=True)
            ]
        )


def fit_mixture(
    histogram: NDArray[np.integer], edges: NDArray[np.float64], iterations: int = RULES.iterations
) -> Mixture:
    """Expectation maximisation on a histogram of normalised residuals (eq. 4.52-4.56; Dempster et al. 1977).

    Args:
        histogram: (n,) counts.
        edges: (n + 1,) edges of the bins.
        iterations: Most iterations.
    """
    centers = (edges[:-1] + edges[1:]) / 2
    prior, static, dynamic = labeling.fit_mixture(
        histogram.astype(np.float64), centers, iterations, START, PRIOR_BOUNDS, STATIC_BOUNDS, SEPARATION, MAX_RESIDUAL
    )
    return Mixture((1 - prior, prior), (static, dynamic))
