"""Analysis of responses whose truth is known: optimum and confirmation."""

import numpy as np
import pandas as pd
import pytest

from dudmap.config import Config
from dudmap.lab.study.designs import DESIGNS, DesignOptions, count_of, make_factors, points_of
from dudmap.lab.study.response_surface import confirm, fit_surface, predict_optimum
from dudmap.lab.study.responses import Scale

RANGES = {"tracker.huber": {"range": [0.005, 0.025]}, "volume.voxel_size": {"range": [0.01, 0.04], "scale": "log"},
          "tracker.color_weight": {"range": [0.025, 0.175]}}  # fmt: skip


def factors_of(table=RANGES):
    return make_factors(table, Config())


def runs_of(factors, options, response, repeats=1, noise=0.0):
    """Table of runs whose response is a function of the coded values."""
    rng, rows = np.random.default_rng(2), []  # one seed in twenty shows a lack of fit by chance
    for number, point in enumerate(points_of(factors, options)):
        x = [float(factor.coded(point[factor.key])) for factor in factors]
        for repeat in range(repeats):
            y = response(*x) + noise * rng.normal()
            rows.append({"point": number, "sequence": "a", "replicate": repeat, **point, "ate": y})
    return pd.DataFrame(rows)


@pytest.mark.parametrize("kind", [kind for kind in DESIGNS if kind != "full-factorial"])
def test_designs_stay_in_their_bounds_and_are_counted(kind):
    factors, options = factors_of(), DesignOptions(kind=kind, samples=8)
    points = points_of(factors, options)
    assert len(points) == count_of(factors, options)
    coded = np.array([[float(f.coded(point[f.key])) for f in factors] for point in points])
    assert np.all(np.abs(coded) <= 1 + 1e-9)
    assert np.all(np.ptp(coded, axis=0) > 0.5)


def test_a_full_factorial_design_has_every_combination_once():
    factors = factors_of(
        {"tracker.huber": [0.005, 0.01], "dynamics.enabled": [True, False], "volume.max_weight": [5, 9]}
    )
    points = points_of(factors, DesignOptions())
    assert len(points) == 8 == len({tuple(point.values()) for point in points})


def test_whole_numbers_stay_whole():
    factors = factors_of({"volume.max_weight": {"range": [10, 99]}, "tracker.huber": {"range": [0.005, 0.01]}})
    points = points_of(factors, DesignOptions(kind="latin-hypercube", samples=5))
    assert all(type(point["volume.max_weight"]) is int for point in points)


def bowl(x, y, z):
    return 0.05 + 0.02 * (x - 0.3) ** 2 + 0.01 * (y + 0.5) ** 2 + 0.01 * z**2


def test_a_quadratic_response_is_found_believed_and_confirmed():
    factors = factors_of()
    table = runs_of(factors, DesignOptions(kind="central-composite"), bowl, repeats=2, noise=2e-4)
    found = predict_optimum(table, factors, Scale("ate"))
    assert found.reasons == ()
    np.testing.assert_allclose(found.best.coded, [0.3, -0.5, 0], atol=0.1)
    truth = bowl(*found.best.coded)
    held = confirm(found.surface, found.best, [truth], [bowl(0, 0, 0)])
    assert held.held
    assert "The prediction was confirmed" in str(held)


def test_two_levels_give_no_quadratic_model():
    factors = factors_of()
    table = runs_of(factors, DesignOptions(kind="plackett-burman"), bowl)
    assert "three or more levels" in fit_surface(table, factors, Scale("ate"))


def test_a_logarithm_is_shown_in_the_unit_of_the_response():
    scale, table = Scale("ate", log=True), pd.DataFrame({"ate_rmse_m": [0.01, 0.02, float("nan")]})
    data = scale.usable(table)
    assert [scale.text(value) for value in data["ate"]] == ["10 mm", "20 mm"]
    assert scale.heading == "log of ATE RMSE, mm"
