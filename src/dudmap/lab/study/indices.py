"""Sensitivity indices of sampled designs: Sobol indices (Sobol 2001, Saltelli 2010) and Morris screening (1991)."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.study.designs import MORRIS_LEVELS, problem
from dudmap.lab.study.factors import Factor, Table, coded_points

FOLDS = 5
"""Folds of the cross-validation of an emulator."""
ENOUGH_PREDICTED = 0.5
"""Smallest share of the variance that an emulator must predict in cross-validation for its indices to be shown."""
EMULATED = 1024
"""Base samples of the indices of an emulator; their error is then small beside that of the emulator."""


def sobol_indices(factors: Sequence[Factor], values: NDArray[np.float64], seed: int = 0) -> Table:
    """First- and second-order and total Sobol indices with their confidence intervals (SALib).

    Args:
        factors: K factors.
        values: (N (2 K + 2),) response of all rows of a Saltelli design, in its order.
        seed: Seed of the bootstrap of the intervals.
    """
    import pandas as pd
    from SALib.analyze.sobol import analyze

    scaled = (values - values.mean()) / values.std()  # the estimators assume a small mean
    found = analyze(problem(factors), scaled, calc_second_order=True, seed=seed)
    rows = []
    for n, factor in enumerate(factors):
        rows.append((factor.name, "first", found["S1"][n], found["S1_conf"][n]))
        rows.append((factor.name, "total", found["ST"][n], found["ST_conf"][n]))
    for a, b in combinations(range(len(factors)), 2):
        name = f"{factors[a].name} x {factors[b].name}"
        rows.append((name, "second", found["S2"][a, b], found["S2_conf"][a, b]))
    return pd.DataFrame(rows, columns=["term", "order", "index", "95 % +-"])


def emulated_indices(table: Table, factors: Sequence[Factor], response: str, seed: int = 0) -> tuple[Table, str]:
    """Sobol indices of a Gaussian process (scikit-learn) that was fitted to the runs.

    Returns:
        The indices, None if the process predicts too little, and a sentence on how much it predicts.
    """
    import warnings

    from SALib.sample.sobol import sample
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.model_selection import KFold, cross_val_predict

    means = table.groupby([factor.key for factor in factors], as_index=False)[response].mean()
    x = coded_points(factors, means)
    y = means[response].to_numpy(float)
    if len(y) < 2 * FOLDS or np.ptp(y) == 0:
        return None, f"{len(y)} different points are too few for an emulator, or the response does not vary."
    lengths: Any = np.ones(len(factors))  # one per factor, which the annotation of scikit-learn forgets
    kernel = ConstantKernel() * RBF(lengths) + WhiteKernel(1e-2)
    process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its bound; cross-validation judges the fit
        guess = cross_val_predict(process, x, y, cv=KFold(FOLDS, shuffle=True, random_state=seed))
        process.fit(x, y)
    share = float(1 - np.sum((guess - y) ** 2) / np.sum((y - y.mean()) ** 2))
    text = f"A Gaussian process predicts {max(share, 0):.0%} of the variance between the points in cross-validation"
    if share < ENOUGH_PREDICTED:
        return None, f"{text}; Sobol indices of it would mean nothing."
    values = process.predict(sample(problem(factors), EMULATED, calc_second_order=True, seed=seed))
    return sobol_indices(factors, np.asarray(values), seed), f"{text}; the indices are those of the process."


def morris_indices(factors: Sequence[Factor], coded: NDArray[np.float64], values: NDArray[np.float64]) -> Table:
    """Mean absolute elementary effect mu* with its interval, mean mu and standard deviation sigma (SALib).

    Args:
        factors: K factors.
        coded: (N (K + 1), K) coded values of a Morris design, in its order.
        values: (N (K + 1),) response.
    """
    import pandas as pd
    from SALib.analyze.morris import analyze

    found = analyze(problem(factors), coded, values, num_levels=MORRIS_LEVELS, seed=0)
    names = [factor.name for factor in factors]
    columns = {"mu*": found["mu_star"], "95 % +-": found["mu_star_conf"], "mu": found["mu"], "sigma": found["sigma"]}
    frame = pd.DataFrame({"factor": names} | {key: np.asarray(value) for key, value in columns.items()})
    return frame.sort_values("mu*", ascending=False, ignore_index=True)
