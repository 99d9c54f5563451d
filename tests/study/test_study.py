"""A whole study of real runs, small enough for a test."""

import csv

import pytest

from dudmap.config import Config
from dudmap.lab.benchmark.measure import measure_sequence
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.study import run_study
from study.here import Here

ROOM = {"scene": "room", "movers": ["person"], "start_dynamic": True, "frames": 6, "camera": [160, 120]}
FACTOR = {"volume.voxel_size": [0.02, 0.03, 0.05]}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    plan = make_plan(
        {
            "factors": FACTOR,
            "sequences": [{**ROOM, "replicates": 2}],
            "responses": ["ate", "ms", "lost", "mask_iou", "memory"],
        }
    )
    conduct = Here()
    return out, run_study(plan, out, conduct), conduct


def rows(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_run_is_in_the_table_with_the_figures_of_the_system(study):
    out, *_ = study
    table = rows(out / "runs.csv")
    assert len(table) == 6
    run = next(row for row in table if row["volume.voxel_size"] == "0.03" and row["replicate"] == "1")
    sequence = Entry("room", parameters={**ROOM, "seed": 1}).open()
    truth = measure_sequence(sequence, Config().override(["volume.voxel_size=0.03"]), None)
    assert float(run["ate_rmse_m"]) == truth["ate_rmse_m"]
    assert float(run["mask_iou_mean"]) == truth["mask_iou_mean"]
    assert float(run["peak_rss_mb"]) > 50


def test_the_optimum_is_confirmed_on_a_new_seed(study):
    out, text, conduct = study
    confirmed = rows(out / "confirmation.csv")
    assert {row["at"] for row in confirmed} == {"optimum", "best point of the design"}
    assert "The prediction was confirmed" in text or "The prediction was not confirmed" in text
    assert len(conduct.runs) in (7, 8)  # the optimum may be the best point


def test_the_report_has_every_response(study):
    out, *_ = study
    report = (out / "report.md").read_text(encoding="utf-8")
    for heading in (
        "ATE RMSE, mm",
        "time per frame, ms",
        "lost frames",
        "mask IoU",
        "peak memory, MB",
        "Confirmation",
        "Means of all points",
    ):
        assert f"## {heading}" in report
    assert (out / "report.html").stat().st_size > 20_000


def test_a_study_without_any_response_says_why(tmp_path):
    plan = make_plan({"factors": FACTOR, "sequences": [ROOM], "responses": ["ate"]})

    def fails(run):
        return {"error": "no frame could be tracked"}

    with pytest.raises(Exception, match="no run has the response ate; the first error: no frame could be tracked"):
        run_study(plan, tmp_path, Here(fails))
