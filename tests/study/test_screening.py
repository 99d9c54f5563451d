"""Screening of all numeric keys: the factors keep to their bounds, and known effects are found and no others."""

from operator import attrgetter

import numpy as np
import pandas as pd
import pytest

from dudmap.config import Config, keys
from dudmap.errors import ConfigError
from dudmap.lab.study.designs import DesignOptions, bounds_of, configured, make_factors, points_of
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.report import Report
from dudmap.lab.study.screening import describe_screening, screen, summary


def factors_of(**changed):
    return make_factors({"all_numeric": {"ratio": 1.5, **changed}}, Config())


def test_every_numeric_key_is_a_factor_and_every_point_is_valid():
    factors = factors_of()
    numeric = {
        key
        for key in keys()
        if key != "system"
        and not key.startswith("thesis.")
        and isinstance(attrgetter(key)(Config()), int | float | tuple)
    }
    numeric = {key for key in numeric if not isinstance(attrgetter(key)(Config()), bool)}
    assert {factor.key for factor in factors} == numeric
    assert len(factors) > 30
    points = points_of(factors, DesignOptions(kind="plackett-burman"))
    assert len(factors) < len(points) / 2 <= len(factors) + 24
    for point in points:
        configured(Config(), point)


def test_the_ends_differ_from_the_value_by_the_ratio_unless_a_bound_or_a_whole_number_says_otherwise():
    ends = {factor.key: (factor.low, factor.high) for factor in factors_of(ratio=2.0)}
    assert ends["tracker.huber"] == (0.005, 0.02)
    assert ends["volume.max_weight"] == (128, 255)  # at most 255
    assert ends["similarity.threshold"] == (0.42, 1.0)  # at most 1
    small = {factor.key: (factor.low, factor.high) for factor in factors_of(ratio=1.01)}
    assert small["volume.min_weight"] == (2, 4)
    for factor in factors_of():
        bounds = bounds_of(factor.key)
        if factor.numeric:
            assert bounds.get("ge", -np.inf) <= factor.low < factor.high <= bounds.get("le", np.inf)
            assert bounds.get("gt", -np.inf) < factor.low < factor.high < bounds.get("lt", np.inf)


def test_a_key_can_be_left_out_or_have_levels_of_its_own():
    table = {"tracker.huber": [0.005, 0.03], "all_numeric": {"without": ["tracker.color_weight", "dynamics.width"]}}
    factors = {factor.key: factor for factor in make_factors(table, Config())}
    assert not {"tracker.color_weight", "dynamics.width"} & set(factors)
    assert factors["tracker.huber"].levels == (0.005, 0.03)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ratio": 0.5}, "above 1"),
        ({"ratio": "big"}, "above 1"),
        ({"rate": 2}, "expected, for example"),
        (True, "expected, for example"),
        ({"without": ["tracker.hubber"]}, "no configuration key"),
    ],
)
def test_mistakes_are_one_sentence(given, words):
    with pytest.raises(ConfigError, match=words):
        make_factors({"all_numeric": given}, Config())


@pytest.fixture(scope="module")
def screened():
    """Responses with two true main effects, one on one recording only, and an interaction of two factors."""
    plan = make_plan(
        {
            "factors": {"all_numeric": {"ratio": 1.5}},
            "design": "plackett-burman",
            "sequences": [{"scene": "room", "frames": 2}, {"name": "other", "scene": "box", "frames": 2}],
            "responses": ["ate", "ms"],
        }
    )
    rng, rows = np.random.default_rng(4), []
    for number, point in enumerate(points_of(plan.factors, plan.options)):
        x = {f.key: float(np.sign(f.coded(point[f.key]))) for f in plan.factors if f.numeric}
        for name, _, _ in plan.entries:
            ate = 5 + 2 * x["volume.voxel_size"] + 2 * x["tracker.huber"] * x["loops.gap"] + rng.normal() / 4
            ate += 1.5 * x["dynamics.margin_px"] * (name == "other")
            row = {"point": number, "sequence": name, "replicate": 0, "ate_rmse_m": ate, "ms_per_frame_median": 1.0}
            rows.append({**row, **point})
    return plan, pd.DataFrame(rows)


def test_known_effects_are_found_and_interactions_are_not_taken_for_them(screened):
    plan, table = screened
    effects = screen(table.assign(ate=table["ate_rmse_m"]), plan.factors, "ate")
    sure = effects[effects["p"] < 0.05]
    assert {("volume.voxel_size", "room"), ("volume.voxel_size", "other"), ("dynamics.margin_px", "other")} == set(
        zip(sure["key"], sure["recording"], strict=True)
    )
    voxel = effects[(effects["key"] == "volume.voxel_size") & (effects["recording"] == "room")].iloc[0]
    assert voxel["low"] < 4 < voxel["high"]  # from -1 to +1


def test_the_report_names_keys_that_matter_and_a_response_that_never_varies_has_none(screened, tmp_path):
    plan, table = screened
    table = table.assign(ate=table["ate_rmse_m"], ms=table["ms_per_frame_median"])
    effects = {name: screen(table, plan.factors, name) for name in ("ate", "ms")}
    assert not (effects["ms"]["p"] < 0.05).any()
    report = Report("screening")
    for name, found in effects.items():
        describe_screening(report, found, name)
    report.save(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert f"2 of {len(plan.factors)} keys affect ate" in text
    assert "volume.voxel_size" in text
    assert f"0 of {len(plan.factors)} keys affect ms" in text
    words = summary(effects)
    assert words.startswith(f"2 of {len(plan.factors)} keys have a significant effect:\nate: volume.voxel_size")
    assert "tracker.huber" in words.partition("Without a significant effect on any response: ")[2]


def test_too_few_runs_are_refused(screened):
    plan, table = screened
    with pytest.raises(ConfigError, match="do not tell apart"):
        screen(table[table["point"] < len(plan.factors) // 2].assign(ate=table["ate_rmse_m"]), plan.factors, "ate")
