"""Suites, published values, tables, scoring of other systems, and the limit of dynamics, on made-up figures."""

import csv
import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.evaluation.surface import moved
from dudmap.io.exporting.mesh_editing import cropped
from dudmap.lab.benchmark import limits, measure, report
from dudmap.lab.benchmark.measure import COMPLETE_WITHIN, markdown, score_parts
from dudmap.lab.benchmark.report import published
from dudmap.lab.benchmark.suites import SUITES, USUAL, Entry, find_suite, systems
from layout_images import pose
from layouts import corbs, icl_nuim, volume_deform, write
from recordings import write_recording

PUBLIC = ("thesis", "tum-dynamic", "bonn", "icl-nuim")


def benchmark(*arguments):
    return CliRunner().invoke(app, ["benchmark", *(str(argument) for argument in arguments)])


@pytest.fixture
def data(tmp_path):
    """A folder with one of the thesis' recordings, whose true camera moves along a curve."""
    folder = tmp_path / "data"
    recording = write_recording(folder / "tum" / "rgbd_dataset_freiburg3_walking_xyz", 12)
    stamps = 100 + 0.1 * np.arange(12)
    Ts = [se3.exp(np.array([0.1 * np.sin(k), 0.02 * k, 0.05 * np.cos(k), 0, 0.01 * k, 0])) for k in range(12)]
    Trajectory(stamps, np.array(Ts)).save(recording / "groundtruth.txt")
    return folder


def test_every_suite_has_the_recordings_the_papers_name(tmp_path):
    counts = {"thesis": 13, "tum-dynamic": 8, "bonn": 26, "icl-nuim": 8}
    for name, count in counts.items():
        suite = find_suite(name, tmp_path)
        assert not suite.entries
        assert len(suite.missing) == count
        assert all(entry.address.startswith("http") for entry in suite.missing)
        assert len(set(suite.names())) == count
    assert len(find_suite("synthetic", None).entries) >= 15
    assert len(find_suite("synthetic", None, quick=True).entries) == 3
    assert len(find_suite("ablation", None).entries) == 5
    assert set(SUITES) == {*counts, "synthetic", "ablation", "sensors", "limits", "fence", "local"}


def test_recordings_are_found_one_folder_down(data):
    suite = find_suite("thesis", data)
    assert [entry.name for entry in suite.entries] == ["rgbd_dataset_freiburg3_walking_xyz"]
    assert len(suite.missing) == 12
    assert len(find_suite("local", data / "tum").entries) == 1
    assert find_suite("tum-dynamic", data, quick=True).entries[0].max_frames == 60
    (one,) = find_suite("tum-dynamic", suite.entries[0].path).entries  # the recording itself
    assert one.path == suite.entries[0].path


def test_recordings_are_found_as_downloaded(tmp_path, monkeypatch):
    """The data sets of the thesis: folders and archives with the names that their pages give them."""
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    data = tmp_path / "data"
    write(corbs, data)  # D1_pre_registereddata
    folder, _ = write(volume_deform, tmp_path / "a")
    shutil.make_archive(str(data / "boxing"), "zip", folder)
    folder, _ = write(icl_nuim, tmp_path / "b")
    shutil.make_archive(str(data / "living_room_traj2_frei_png"), "gztar", folder)
    suite = find_suite("thesis", data)
    assert [entry.name for entry in suite.entries] == ["living_room_traj2_frei_png", "D1", "boxing"]
    assert len(suite.missing) == 10
    for entry in suite.entries:
        np.testing.assert_allclose(entry.open().ground_truth.Ts_world_camera[-1], pose(2), atol=1e-6)


def test_published_figures_belong_to_recordings_of_the_suites_and_name_their_source(tmp_path):
    known = {name for suite in PUBLIC for name in find_suite(suite, tmp_path).names()}
    figures = published()
    assert {figure.sequence for figure in figures} <= known
    assert all(len(figure.source) > 10 for figure in figures)
    assert all(np.isfinite(figure.value) and figure.value > 0 for figure in figures)
    printed = {(figure.sequence, figure.system, figure.metric, figure.source[:10]): figure.value for figure in figures}
    assert len(printed) == len(figures)
    xyz = {f.system: f.value for f in published(["rgbd_dataset_freiburg3_walking_xyz"]) if f.metric == "ate_rmse_m"}
    assert xyz["DUDMap (thesis)"] == pytest.approx(0.074)
    assert xyz["ReFusion"] == pytest.approx(0.099)
    assert {"VO-SF": 0.87, "Semantic SLAM": 0.016}.items() <= xyz.items()
    (d1,) = (figure.value for figure in published(["D1"]) if figure.metric == "ate_rmse_m")
    assert d1 == 0.0071  # section 5.1.2
    crowd3 = {figure.system: figure.value for figure in published(["rgbd_bonn_crowd3"])}
    assert crowd3["StaticFusion"] == pytest.approx(0.168)
    lr2 = {f.metric: f.value for f in published(["living_room_traj2_frei_png"]) if f.system.startswith("DUDMap")}
    assert lr2 == {
        "ate_rmse_m": 0.004, "rpe_trans_rmse_m_per_s": 0.007, "rpe_rot_rmse_deg_per_s": 0.149, "mesh_accuracy_m": 0.004
    }  # fmt: skip


def test_parts_of_the_fence_are_in_view_and_scored_alone(tmp_path):
    """A mesh that ends in the middle of one box, and does not reach the other."""
    (entry,) = find_suite("fence", None).entries
    entry = replace(entry, parameters=entry.parameters | {"camera": (320, 240)})
    seen = entry.surfaces(entry.open())[1]
    assert {name: len(cropped(seen, box).faces) > 100 for name, box in entry.parts.items()} == {
        "slats": True, "wires": True
    }  # fmt: skip
    assert {config.volume.voxel_size for config in systems(USUAL["fence"]).values()} == {0.005, 0.01, 0.02}
    poses = Trajectory(np.arange(3.0), np.array([pose(k) for k in range(3)]))
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.9]))  # the world of the run in the true one
    Trajectory(poses.timestamps, se3.inverse(T) @ poses.Ts_world_camera).save(tmp_path / "trajectory.txt")
    moved(plane(0, 1), se3.inverse(T)).save(tmp_path / "mesh.ply")
    unseen = cropped(plane(0, 1), (5, 5, 5, 6, 6, 6))
    row = score_parts(tmp_path, poses, {"slats": plane(0, 2), "wires": plane(3, 4), "unseen": unseen})
    assert set(row) == {"completeness_slats", "completeness_wires"}
    assert row["completeness_slats"] == pytest.approx((1 + COMPLETE_WITHIN) / 2, abs=0.01)
    assert row["completeness_wires"] == 0


def plane(start, end):
    """Strip of 1 m at z = 1 from one x to another."""
    vertices = np.array([[start, 0, 1], [end, 0, 1], [end, 1, 1], [start, 1, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(vertices, faces, np.zeros((4, 3), np.uint8), np.tile(np.float32([0, 0, -1]), (4, 1)))


def test_systems_are_configurations(tmp_path):
    found = systems("dudmap,none,thesis")
    assert not found["none"].dynamics.enabled
    assert found["thesis"].system == "thesis"
    assert (
        len({str(config) for config in systems(USUAL["ablation"]).values()}) == 8
    )  # two-passes has the default configuration
    (tmp_path / "mine.toml").write_text("[tracker]\nhuber = 0.05\n")
    assert systems(str(tmp_path / "mine.toml"))["mine"].tracker.huber == 0.05
    for text in ("", "dudmapp", "none,none"):
        with pytest.raises(ConfigError):
            systems(text)


def test_what_another_system_computed_stands_in_the_same_table(data, tmp_path, monkeypatch):
    name = "rgbd_dataset_freiburg3_walking_xyz"
    monkeypatch.setattr(
        report, "measure_all", lambda jobs, workers, done: [
            {"sequence": job.entry.name, "system": job.system, "frames": 12, "lost": 1, "ate_rmse_m": 0.0123}
            for job in jobs
        ]
    )  # fmt: skip
    peer = tmp_path / "peer" / name
    peer.mkdir(parents=True)
    truth = Trajectory.load(data / "tum" / name / "groundtruth.txt")
    world = se3.exp(np.array([1, 2, 3, 0.4, 0.5, 0.6]))
    Trajectory(truth.timestamps[:10], world @ truth.Ts_world_camera[:10]).save(peer / "trajectory.txt")
    outcome = benchmark(
        "thesis", "--data", data, "--out", tmp_path / "out", "--systems", "dudmap,none", "--score",
        f"peer={tmp_path / 'peer'}",
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    text = (tmp_path / "out" / "thesis.md").read_text()
    assert text.strip() in outcome.stdout
    assert "| **dudmap** | measured here | 12.3 |" in text
    assert "| ReFusion | [" in text
    assert "rgbd_bonn_balloon_tracking2: https://" in text
    rows = {row["system"]: row for row in json.loads((tmp_path / "out" / "thesis.json").read_text())["rows"]}
    assert set(rows) == {"dudmap", "none", "peer"}
    assert rows["peer"]["ate_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert rows["peer"]["drift_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert rows["peer"]["lost"] == 2
    with (tmp_path / "out" / "thesis.csv").open() as file:
        assert [row["system"] for row in csv.DictReader(file)] == ["dudmap", "none", "peer"]


def test_a_recording_that_fails_is_a_line_not_the_end():
    good = {"sequence": "a", "system": "x", "ate_rmse_m": 0.01, "lost": 0}
    text = markdown([good, {"sequence": "b", "system": "x", "error": "its depth is missing"}])
    assert "| a | x | 0 | 10.0 |" in text
    assert "- b, x: its depth is missing" in text
    assert "mask IoU" not in text


def test_a_run_in_its_own_process_reports_an_unusable_recording(tmp_path):
    (tmp_path / "empty").mkdir()
    job = measure.Job(Entry("empty", tmp_path / "empty"), "dudmap", systems("dudmap")["dudmap"])
    (row,) = measure.measure_all([job], 1)
    assert row["sequence"] == "empty"
    assert "is empty" in row["error"]


def dies(_):
    os._exit(3)


def raises(_):
    raise ValueError("a defect")


def test_a_process_that_dies_or_fails_is_an_error_of_its_row(capfd):
    assert "died" in measure.in_own_process(dies, None)["error"]
    assert measure.in_own_process(raises, None)["error"] == "ValueError: a defect"
    assert "a defect" in capfd.readouterr().err
    assert measure.in_own_process(dict, [("lost", 0)]) == {"lost": 0}


# -- the limit of dynamics --------------------------------------------------------------------------------------------


def ates_of(sweep, value, ates):
    """Rows of one value of a sweep with these ATEs, metres, in the order of its shares."""
    return [
        {"sequence": limits.name_of(sweep, value, share), "system": "dudmap", "ate_rmse_m": ate, "lost": 0}
        for share, ate in zip(sweep["coverages"], ates, strict=True)
    ]


def test_the_limit_is_the_largest_share_below_the_first_failure():
    sweep = limits.SWEEPS["speed"]
    rows = ates_of(sweep, 0.1, (0.005, 0.03, 0.01, 0.01)) + ates_of(sweep, 1.0, (0.005, 0.006, 0.01, 0.02))
    table = limits.limits_table(rows, ["dudmap", "none"])
    assert "| 0.1 | 30 % |  |" in table  # the other system was not measured
    assert "| 1.0 | 90 % |  |" in table
    rows[-1]["ate_rmse_m"], rows[-2]["lost"] = 0.0201, 1
    assert "| 1.0 | 50 % |  |" in limits.limits_table(rows, ["dudmap", "none"])
    rows[4]["lost"] = 2
    assert "| 1.0 | none |" in limits.limits_table(rows, ["dudmap"])


def test_the_worlds_hold_what_is_asked_for():
    worlds = [Entry(name, parameters=world | {"frames": 2}) for name, world in limits.worlds().items()]
    assert len(worlds) == 6 * 4 + 3 + 4 * 3
    parameters = [world.parameters for world in worlds]
    assert min(world["speed"] for world in parameters) <= 0.02
    assert max(world["speed"] for world in parameters) >= 3
    assert {world.get("camera_path") for world in parameters} >= {"still", "fast"}
    assert max(world["coverage"] for world in parameters) == 0.9
    at_start = Entry("x", parameters=limits.worlds()["start_dynamic-True-40"] | {"frames": 2}).open()
    assert at_start.mask(0).mean() > 0.2


def test_mistakes_are_one_sentence(tmp_path):
    cases = [
        (("bonn",), "name their folder with --data"),
        (("bonn", "--data", tmp_path / "none"), "there is no folder"),
        (("local", "--data", tmp_path), "no recording found"),
        (("synthetic", "--systems", "best"), "unknown system 'best'"),
        (("synthetic", "--score", "peer"), "expected NAME=FOLDER"),
    ]
    for arguments, sentence in cases:
        outcome = benchmark(*arguments)
        assert outcome.exit_code == 1, arguments
        assert sentence in outcome.stderr
        assert len(outcome.stderr.strip().splitlines()) == 1
    with pytest.raises(DatasetError):
        Entry("x", tmp_path / "none").open()
    with pytest.raises(ConfigError, match="known suites"):
        find_suite("all", tmp_path)
