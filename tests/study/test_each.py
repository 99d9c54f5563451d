"""A model and a confirmation for every recording; time in words."""

import pytest

from dudmap.errors import ConfigError
from dudmap.lab.study.conduct import Progress
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.study import run_study
from study.here import Here

ROOM = {"scene": "room", "movers": [], "frames": 6, "camera": [160, 120]}
LEVELS = [0.005, 0.0075, 0.01, 0.0125, 0.015]


def response(run, out):
    """A parabola whose optimum depends on the recording; on one recording a confirmation is worse than all that."""
    at = {"near": 0.007, "far": 0.012, "trap": 0.0085}[run.sequence]
    worse = 0.5 if run.sequence == "trap" and run.values["tracker.huber"] not in LEVELS else 0.0
    bump = 1e-3 * ((run.values["tracker.huber"] * 1e4) % 3)  # no model is exact
    return {
        "ate_rmse_m": 0.1 + 1e4 * (run.values["tracker.huber"] - at) ** 2 + worse + bump,
        "lost": 0,
        "tracked_share": 0.5 if run.sequence == "far" else 1.0,
    }


def test_every_recording_has_an_optimum_and_a_confirmation_of_its_own(tmp_path):
    import pandas as pd

    tree = {
        "factors": {"tracker.huber": LEVELS},
        "sequences": [{**ROOM, "name": name, "seed": 10 * n} for n, name in enumerate(("near", "far", "trap"))],
        "responses": ["ate"],
        "each": True,
        "confirm": 1,
    }
    run_study(make_plan(tree), tmp_path, Here(response))
    each = pd.read_csv(tmp_path / "each.csv").set_index("recording")
    assert each.loc["near", "huber"] == pytest.approx(0.007, abs=7e-4)
    assert each.loc["far", "huber"] == pytest.approx(0.012, abs=7e-4)
    assert each.loc["near", "measured"] == pytest.approx(100, abs=5)
    assert each.loc["trap", "held"] == "no"
    assert each.loc["trap", "measured"] > 500
    report = (tmp_path / "report.md").read_text()
    assert "each recording on its own" in report
    assert "5 of 15 runs tracked less than 90% of the frames" in report


def test_progress_says_time_left_and_core_hours():
    state = Progress(total=100, done=20, begun=10, spent=7200.0, started=0.0, cores=2)
    assert "4.0 h of about 20.0 h of core time" in state.describe()
    assert "left" in state.describe()
    assert "3 s of about 26 s of core time" in Progress(total=9, done=1, begun=0, spent=2.836).describe()
    assert "run 0 of 9, 0 s of about 0 s of core time" in Progress(9, 0, 0).describe()


def test_a_plackett_burman_design_needs_two_levels():
    plan = make_plan({"factors": {"tracker.huber": LEVELS}, "design": "plackett-burman", "sequences": [ROOM]})
    with pytest.raises(ConfigError, match=r"two levels, but tracker\.huber has 5"):
        plan.check()
