"""Design files: what they say is what is run, and every mistake is one sentence before anything is run."""

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.errors import DudmapError
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.study import thesis_plan
from dudmap.lab.study.tune import check_tune
from recordings import write_recording

ROOM = {"scene": "room", "movers": [], "frames": 6, "camera": [160, 120]}
GOOD = {"factors": {"tracker.huber": [0.005, 0.01, 0.02]}, "sequences": [ROOM], "responses": ["ate"]}


def test_runs_are_points_times_sequences_times_replicates():
    plan = make_plan(
        {
            "base": ["device=cpu"],
            "factors": {"tracker": {"huber": [0.005, 0.01]}, "dynamics.enabled": [True, False]},
            "sequences": [{**ROOM, "replicates": 3, "seed": 5}, {"name": "other", "scene": "box", "frames": 6}],
            "responses": ["ate", "ms"],
        }
    )
    runs = plan.runs()
    assert len(runs) == 4 * 4 == len({run.key for run in runs})
    assert {run.entry.parameters["seed"] for run in runs if run.sequence == "room"} == {5, 6, 7}
    assert {run.config.device for run in runs} == {"cpu"}
    assert {(run.config.tracker.huber, run.config.dynamics.enabled) for run in runs} == {
        (huber, enabled) for huber in (0.005, 0.01) for enabled in (True, False)
    }


def test_confirmation_runs_have_seeds_that_were_never_seen():
    plan = make_plan({**GOOD, "sequences": [{**ROOM, "replicates": 2}], "confirm": 3})
    seen = {run.entry.parameters["seed"] for run in plan.runs()}
    fresh = [run.entry.parameters["seed"] for run in plan.confirmation_runs({"tracker.huber": 0.013})]
    assert len(fresh) == 3
    assert not seen & set(fresh)


def test_the_same_run_has_the_same_key_and_another_one_has_not():
    first, second = make_plan(GOOD), make_plan({**GOOD, "factors": {"tracker.huber": [0.01, 0.03]}})
    keys = [{run.values["tracker.huber"]: run.key for run in plan.runs()} for plan in (first, second)]
    assert keys[0][0.01] == keys[1][0.01]
    assert len(set(keys[0].values()) | set(keys[1].values())) == 4
    longer = make_plan({**GOOD, "sequences": [{**ROOM, "frames": 7}]})
    assert not {run.key for run in first.runs()} & {run.key for run in longer.runs()}


@pytest.mark.parametrize(
    ("table", "runs"), [("4.1", 16), ("4.2", 8), ("6.1", 81), ("6.2", 10), ("6.3", 12), ("figure 4.5", 7)]
)
def test_the_studies_of_the_thesis_have_its_runs(table, runs):
    plan = thesis_plan(table)
    plan.check()
    assert len(plan.runs()) == runs
    assert {run.config.system for run in plan.runs()} == {"thesis"}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"factors": {"tracker.hubber": [0.1, 0.2]}}, "the nearest known key is 'tracker.huber'"),
        ({"factors": {"tracker.huber": [-1.0, 0.2]}}, "tracker.huber = -1.0 is not acceptable"),
        ({"factors": {"volume.voxel_size": {"range": [0.01, 2]}}}, "volume.voxel_size = 2"),
        ({"factors": {"tracker.huber": {"range": [0.2, 0.1]}}}, "expected two growing numbers"),
        ({"factors": {"tracker.huber": [0.1]}}, "two or more different values"),
        ({"factors": {"tracker.huber": 0.1}}, "expected a list of levels"),
        ({"factors": {"volume.max_weight": {"range": [1.5, 9]}}}, "whole numbers"),
        ({"factors": {}}, "no factors"),
        ({"factors": {"tracker.huber": {"range": [0.01, 0.02]}}}, "needs levels, but tracker.huber has a range"),
        ({"design": "hexagonal"}, "kind of the design is 'hexagonal'; expected one of full-factorial"),
        ({"design": "central-composite", "factors": {"tracker.huber": {"range": [0.01, 0.1]}}}, "two factors"),
        ({"design": {"sample": 5}}, "unknown key 'sample' of the design"),
        ({"design": {"samples": "many"}}, "samples of the design is 'many'"),
        ({"sequences": []}, "no sequences"),
        ({"sequences": [{"path": "nowhere"}]}, "there is no folder"),
        ({"sequences": [{"scene": "moon"}]}, "moon"),
        ({"sequences": [{"scenery": "room"}]}, "no parameter 'scenery'"),
        ({"sequences": [ROOM, ROOM]}, "the name 'room'"),
        ({"sequences": [{**ROOM, "replicates": 0}]}, "replicates"),
        ({"sequences": [{**ROOM, "camera": 160}]}, "expected [width, height]"),
        ({"responses": ["speed"]}, "unknown response 'speed'"),
        ({"responses": ["mask_iou"]}, "no true masks of anything that moves"),
        ({"responses": ["rpe"]}, "shorter than one second"),
        ({"base": ["system=best"]}, "system = 'best'"),
        ({"confirm": -1}, "confirmation runs"),
        ({"calibrate": "yes"}, "true or false"),
        ({"faktors": {}}, "unknown key 'faktors' of the design"),
        ({"factors": {"volume.min_weight": [3, 200]}, "base": ["volume.max_readings=48"]}, "min_weight"),
    ],
)  # fmt: skip
def test_every_mistake_is_one_sentence_before_anything_is_run(changed, words):
    with pytest.raises(DudmapError) as error:
        make_plan({**GOOD, **changed}).check()
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_design_larger_than_max_runs_is_refused():
    with pytest.raises(DudmapError, match="3 runs, more than --max-runs 2"):
        make_plan(GOOD).check(max_runs=2)
    huge = {"design": {"kind": "latin-hypercube", "samples": 2**20}, "factors": {"tracker.huber": {"range": [0.1, 1]}}}
    with pytest.raises(DudmapError, match="1048576 runs"):
        make_plan({**GOOD, **huge}).check()


@pytest.mark.parametrize(("response", "words"), [("ate", "no true trajectory"), ("mesh_accuracy", "no true"),
                                                 ("mask_iou", "no true masks")])  # fmt: skip
def test_a_recording_without_the_truth_is_refused(tmp_path, response, words):
    folder = write_recording(tmp_path / "desk", 3)
    (folder / "groundtruth.txt").unlink(missing_ok=True)
    with pytest.raises(DudmapError, match=words):
        make_plan({**GOOD, "sequences": [{"path": str(folder)}], "responses": [response]}).check()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"responses": ["lost"]}, "cannot use the response lost"),
        ({"judge": [ROOM]}, "has 1 recordings"),
        ({"judge": [{**ROOM, "replicates": 3}]}, "in both sets"),
        ({"judge": [{**ROOM, "replicates": 3, "seed": 9}], "tune": {"trials": 999}}, "more than --max-runs"),
        ({"tune": {"trails": 3}}, "unknown key 'trails' of tune"),
    ],
)
def test_mistakes_of_a_search(changed, words):
    with pytest.raises(DudmapError, match=words):
        check_tune(make_plan({**GOOD, **changed}))


def test_the_command_refuses_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.toml").write_text('[factors]\n"tracker.hubber" = [1, 2]\n')
    for arguments in (
        ["bad.toml"],
        ["none.toml"],
        ["tune", "bad.toml"],
        ["thesis", "--table", "9"],
        ["thesis", "nowhere"],
    ):
        result = CliRunner().invoke(app, ["study", *arguments])
        assert result.exit_code == 1, result.output
        assert len(result.stderr.strip().splitlines()) == 1
        assert result.stderr.startswith("dudmap: ")
    assert not (tmp_path / "runs").exists()
