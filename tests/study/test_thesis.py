"""Fed the values of the thesis' table 6.1, the analysis finds its optimum, and that it must not be believed."""

import csv

import numpy as np
import pytest

from dudmap.lab.study.effects import anova, interactions, main_effects
from dudmap.lab.study.response_surface import predict_optimum
from dudmap.lab.study.responses import Scale
from dudmap.lab.study.study import DAMPING, HUBER, VOXEL, WEIGHT, published_report, published_table, thesis_plan

# Table 6.1 as printed: Huber constant, regularisation, one row per voxel size 0.01, 0.02, 0.05 m, one column per weight
# 0.025, 0.1, 0.175.
PRINTED = {
    (0.005, 0.002): ((0.098, 0.096, 0.102), (0.101, 0.096, 0.113), (0.102, 0.116, 0.171)),
    (0.005, 0.02): ((0.095, 0.091, 0.097), (0.099, 0.093, 0.108), (0.102, 0.109, 0.165)),
    (0.005, 0.01): ((0.097, 0.093, 0.100), (0.100, 0.093, 0.109), (0.102, 0.104, 0.170)),
    (0.01, 0.002): ((0.110, 0.083, 0.092), (0.105, 0.086, 0.094), (0.092, 0.108, 0.097)),
    (0.01, 0.02): ((0.108, 0.080, 0.088), (0.105, 0.085, 0.092), (0.092, 0.094, 0.114)),
    (0.01, 0.01): ((0.108, 0.085, 0.089), (0.105, 0.094, 0.093), (0.092, 0.081, 0.112)),
    (0.025, 0.002): ((0.118, 0.104, 0.090), (0.101, 0.107, 0.097), (0.365, 0.095, 0.101)),
    (0.025, 0.02): ((0.117, 0.103, 0.090), (0.101, 0.106, 0.096), (0.100, 0.096, 0.102)),
    (0.025, 0.01): ((0.117, 0.104, 0.089), (0.101, 0.106, 0.097), (0.107, 0.094, 0.102)),
}
FACTORS = thesis_plan().factors


@pytest.fixture(scope="module")
def table():
    return published_table()


@pytest.fixture(scope="module")
def predicted(table):
    return predict_optimum(Scale("ate").usable(table), FACTORS, Scale("ate"))


def test_the_table_is_the_printed_one(table):
    found = {(r[HUBER], r[DAMPING], r[VOXEL], r[WEIGHT]): r["ate_rmse_m"] for r in table.to_dict("records")}
    printed = {
        (huber, damping, voxel, weight): value
        for (huber, damping), rows in PRINTED.items()
        for voxel, row in zip((0.01, 0.02, 0.05), rows, strict=True)
        for weight, value in zip((0.025, 0.1, 0.175), row, strict=True)
    }
    assert len(table) == 81
    assert found == printed


def test_main_effects_are_those_of_figure_6_1(table):
    effects = main_effects(table, FACTORS, "ate_rmse_m")
    best = effects.loc[effects.groupby("factor")["mean"].idxmin()].set_index("factor")["level"].to_dict()
    assert best == {HUBER: 0.01, DAMPING: 0.02, VOXEL: 0.01, WEIGHT: 0.1}  # the values that section 6.1 reads from it
    assert np.average(effects["mean"], weights=effects["runs"]) == pytest.approx(table["ate_rmse_m"].mean())


def test_interactions_show_what_section_6_1_describes(table):
    pairs = interactions(table, FACTORS, "ate_rmse_m")
    # "smaller voxels improve the tracking except where the Huber constant is 0.025"
    by_huber = pairs[HUBER, VOXEL]
    assert all(np.all(np.diff(by_huber.loc[huber]) > 0) for huber in (0.005, 0.01))
    assert not np.all(np.diff(by_huber.loc[0.025]) > 0)


def test_analysis_of_variance_splits_all_of_the_variance(table):
    variance, _ = anova(table, FACTORS, "ate_rmse_m")  # balanced: the sums of squares add up
    assert variance["sum of squares"].sum() == pytest.approx(np.var(table["ate_rmse_m"]) * 81)
    assert variance["dof"].sum() == 80
    assert variance["partial eta2"].dropna().between(0, 1).all()


def test_the_quadratic_optimum_is_that_of_the_thesis(predicted):
    values = predicted.best.values
    assert values[HUBER] == pytest.approx(0.0165, abs=5e-5)
    assert values[DAMPING] == pytest.approx(0.0104, abs=5e-5)
    assert values[VOXEL] == pytest.approx(0.010, abs=1e-9)
    assert values[WEIGHT] == pytest.approx(0.130, abs=5e-4)
    assert predicted.best.predicted == pytest.approx(70.6, abs=0.05)


def test_the_model_is_that_of_a_plain_least_squares_fit(table, predicted):
    x = np.column_stack([f.coded(table[f.key]) for f in FACTORS])
    terms = [np.ones(81), *x.T, *(x[:, i] * x[:, j] for i in range(4) for j in range(i, 4))]
    A, y = np.column_stack(terms), 1000 * table["ate_rmse_m"].to_numpy()
    fit = A @ np.linalg.lstsq(A, y, rcond=None)[0]
    np.testing.assert_allclose(predicted.surface.predict(x), fit, atol=1e-9)


def test_it_says_why_the_optimum_must_not_be_believed(predicted):
    surface = predicted.surface
    assert surface.r2 == pytest.approx(0.36, abs=0.005)
    assert surface.residual_sd == pytest.approx(29, abs=0.5)
    reasons = " ".join(predicted.reasons)
    for words in ("R2 = 0.36", "29.2", "below everything observed (80 mm)"):
        assert words in reasons


def test_the_thesis_own_confirmation_failed(tmp_path):
    text = published_report(tmp_path)
    assert "Predicted 70.58 mm, measured 89 mm" in text
    assert "The prediction was not confirmed." in text
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 3
    assert "<img" in page
    assert 'src="figures' not in page
    shown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert all((tmp_path / "figures" / name).is_file() for name in
               (part.partition(")")[0] for part in shown.split("](figures/")[1:]))  # fmt: skip
    with (tmp_path / "runs.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 81
