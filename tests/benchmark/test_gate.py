"""The accuracy gate: figures must stay as good as recorded in gate.toml, and a spoiled system must be caught."""

import pickle
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.lab.benchmark import gate

HERE = Path(__file__).parents[1]
RECORDED = gate.load_figures(HERE / "gate.toml")
ENTRIES = {entry.name: entry for entry in gate.gate_entries(HERE / "fixtures")}
QUICK = {"room-people-at-start", gate.EXCERPT}
"""Recordings of each ``make test``: one world with people from the first frame on, and real images."""


def failures(rows, recorded=RECORDED):
    return {(check["sequence"], check["figure"]) for check in gate.compare(rows, recorded) if not check["passed"]}


@pytest.fixture(scope="module", autouse=True)
def _rooms_are_built_once():
    """The surfaces of a scene are divided into triangles once for all recordings of it."""
    from dudmap.lab.synthetic import recording

    made, tessellate = {}, recording.tessellate

    def once(*scene):
        key = pickle.dumps(scene[:-1])
        if key not in made:
            made[key] = tessellate(*scene)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "tessellate", once)
        yield


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ENTRIES]
)
def test_accuracy_is_no_worse_than_recorded(name):
    checks = gate.compare(gate.measure_gate([ENTRIES[name]], Config()), RECORDED)
    assert all(check["passed"] for check in checks), "\n" + gate.verdict(checks)
    if name.startswith("room"):
        measured = {check["figure"] for check in checks}
        assert {"lost", "ate_rmse_m", "mask_iou_mean", "mesh_completeness", "ghost_area_m2"} <= measured


@pytest.mark.slow
def test_a_spoiled_tracker_does_not_pass():
    spoiled = Config().override(["tracker.iterations=[1,0,0]", "dynamics.start_seconds=0"])
    rows = gate.measure_gate([ENTRIES["desk-fast-camera"]], spoiled)
    caught = {figure for _, figure in failures(rows)}
    assert caught & {"lost", "ate_rmse_m"}, rows  # it drifts, or notices that it does


def test_the_command_shows_the_table_and_fails(tmp_path, monkeypatch):
    measured = [{"sequence": "room-person", "ate_rmse_m": 0.004, "mask_iou_mean": 0.5, "lost": 0}]
    monkeypatch.setattr(gate, "measure_gate", lambda entries, config: measured)
    file = tmp_path / "gate.toml"
    good = CliRunner().invoke(app, ["benchmark", "gate", "--figures", str(file), "--update"])
    assert good.exit_code == 0, good.output
    assert CliRunner().invoke(app, ["benchmark", "gate", "--figures", str(file)]).exit_code == 0
    measured[0]["mask_iou_mean"] = 0.4
    bad = CliRunner().invoke(app, ["benchmark", "gate", "--figures", str(file)])
    assert bad.exit_code == 1
    assert "| room-person | mask_iou_mean | 0.5 | >= 0.47 | 0.4 | NO |" in bad.stdout
    assert "1 of 3 figures are worse" in bad.stderr


def test_margins_leave_room_in_the_bad_direction_only():
    recorded = {
        "margins": {
            "ate_rmse_m": {"relative": 0.1, "absolute": 0.001},
            "mask_iou_mean": {"relative": 0.0, "absolute": 0.05},
            "lost": {"relative": 0.0, "absolute": 0.0},
        },
        "figures": {"x": {"ate_rmse_m": 0.01, "mask_iou_mean": 0.8, "lost": 1}},
    }
    fine = {"sequence": "x", "ate_rmse_m": 0.01199, "mask_iou_mean": 0.751, "lost": 1}
    better = {"sequence": "x", "ate_rmse_m": 0.0, "mask_iou_mean": 1.0, "lost": 0}
    worse = {"sequence": "x", "ate_rmse_m": 0.01201, "mask_iou_mean": 0.749, "lost": 2}
    assert failures([fine], recorded) == set()
    assert failures([better], recorded) == set()
    assert failures([worse], recorded) == {("x", key) for key in ("ate_rmse_m", "mask_iou_mean", "lost")}
    assert failures([{"sequence": "x"}], recorded) == failures([worse], recorded), "a figure that is missing is worse"


def test_unrecorded_and_unreadable_figures_are_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="no recorded figures of somewhere"):
        gate.compare([{"sequence": "somewhere"}], RECORDED)
    with pytest.raises(ConfigError, match="--update creates the file"):
        gate.load_figures(tmp_path / "none.toml")
    (tmp_path / "gate.toml").write_text("[margins]\n")
    with pytest.raises(ConfigError, match=r"no \[figures\]"):
        gate.load_figures(tmp_path / "gate.toml")


def test_recording_keeps_reviewed_margins(tmp_path):
    path = tmp_path / "gate.toml"
    gate.save_figures(path, [{"sequence": "x", "lost": 3}], {"lost": {"relative": 0.5, "absolute": 1.0}})
    content = gate.load_figures(path)
    assert content["figures"] == {"x": {"lost": 3}}
    assert content["margins"]["lost"] == {"relative": 0.5, "absolute": 1.0}
    assert content["margins"]["mask_iou_mean"]["absolute"] == 0.03
