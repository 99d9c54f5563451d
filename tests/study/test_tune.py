"""A search recommends what holds on recordings it never saw, and nothing else."""

import pytest

from dudmap.config import Config
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.tune import run_tune
from study.here import Here

SMALL = {"scene": "room", "movers": [], "frames": 30, "camera": [160, 120]}


def plan_of(**more):
    return make_plan(
        {
            "factors": {"tracker.huber": {"range": [0.005, 0.05]}, "tracker.exposure": [True, False]},
            "sequences": [{**SMALL, "name": "training", "replicates": 2}],
            "judge": [{**SMALL, "name": "judge", "replicates": 4, "seed": 50}],
            "responses": ["ate", "ms"],
            "tune": {"trials": 24, **more},
        }
    )


def figures(run, right):
    """ATE with its minimum at ``right``; a little of it belongs to the recording."""
    seed = run.entry.parameters["seed"]
    ate = (0.01 + (run.config.tracker.huber - right) ** 2 * 40) * (1 + 0.01 * (seed % 7))
    return {
        "ate_rmse_m": ate * (1 + 1e-3 * (seed % 3) * run.config.tracker.huber),
        "ms_per_frame_median": 10.0,
        "lost": 0,
    }


def holds_everywhere(run):
    return figures(run, 0.03)


def holds_in_training_only(run):
    return figures(run, 0.03 if run.entry.parameters["seed"] < 50 else 0.01)


def loses_frames_elsewhere(run):
    row = holds_everywhere(run)
    lost = run.entry.parameters["seed"] >= 50 and run.config.tracker.huber > 0.011
    return {**row, "lost": int(lost)}


def test_what_holds_is_recommended(tmp_path):
    text = run_tune(plan_of(), tmp_path, Here(holds_everywhere))
    found = Config.load(tmp_path / "recommended.toml")
    assert found.tracker.huber == pytest.approx(0.03, abs=0.006)
    assert "Recommended" in text
    assert "second set" in text


@pytest.mark.parametrize("figures_of", [holds_in_training_only, loses_frames_elsewhere])
def test_what_does_not_hold_is_not_recommended(tmp_path, figures_of):
    text = run_tune(plan_of(), tmp_path, Here(figures_of))
    assert "No configuration is recommended" in text
    assert "training" in text
    assert not (tmp_path / "recommended.toml").exists()


def test_a_stopped_search_goes_on(tmp_path):
    def stops(run):
        if len(conduct.rows) == 30:
            raise KeyboardInterrupt
        return holds_everywhere(run)

    conduct = Here(stops)
    with pytest.raises(KeyboardInterrupt):
        run_tune(plan_of(), tmp_path, conduct)
    done, conduct.figures = set(conduct.rows), holds_everywhere
    conduct.runs.clear()
    assert "Recommended" in run_tune(plan_of(), tmp_path, conduct)
    assert conduct.runs
    assert not done & {run.key for run in conduct.runs}
