"""Trajectories of other programs: each format is recognised, given by an option, or refused; evo reads the same."""

import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.io.exporting.exporters import EXPORTERS, export_run
from layouts import bonn, tum, write

START = 1403636579.763555527
"""First time of EuRoC's V1_01_easy, seconds."""


def evaluate(*arguments):
    return CliRunner().invoke(app, ["evaluate", *(str(argument) for argument in arguments)])


def figures(*arguments):
    outcome = evaluate(*arguments, "--json")
    assert outcome.exit_code == 0, outcome.output
    return json.loads(outcome.stdout)


def hand_held(seed=0, frames=150, noise=0.0):
    """Poses (N, 4, 4) of a smooth path that turns about all axes; noise in metres and radians."""
    t = np.arange(frames) / 30
    phase = np.random.default_rng(3).uniform(0, 6, 6)
    waves = np.stack([0.8 * np.sin(0.9 * t * (1 + 0.3 * k) + phase[k]) for k in range(6)], axis=1)
    scatter = np.random.default_rng(seed).normal(0, noise, (frames, 6)) if noise else np.zeros((frames, 6))
    return np.array([se3.exp(xi) @ se3.exp(more) for xi, more in zip(waves, scatter, strict=True)])


def parts(Ts):
    """Times in whole nanoseconds, positions and quaternions xyzw (of SciPy)."""
    stamps = [round(START * 1e9) + round(k * 1e9 / 30) for k in range(len(Ts))]
    return stamps, Ts[:, :3, 3], Rotation.from_matrix(Ts[:, :3, :3]).as_quat()


def lines(Ts, order="xyzw", separator=" ", per_second=1, header="", more=""):
    out = [header] if header else []
    for t, p, q in zip(*parts(Ts), strict=True):
        stamp = f"{t / 1e9:.6f}" if per_second == 1 else str(t // (10**9 // per_second))
        numbers = [*p, *(q["xyzw".index(letter)] for letter in order)]
        out.append(separator.join([stamp, *(f"{number:.9f}" for number in numbers)]) + more)
    return "\n".join(out) + "\n"


def matrices(Ts, rows=3):
    return "".join(" ".join(f"{number:.9e}" for number in T[:rows].ravel()) + "\n" for T in Ts)


EUROC = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
STATES = EUROC.replace("timestamp [ns]", "timestamp") + ",v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"
OF_STRANGERS = {
    "EuRoC": dict(order="wxyz", separator=",", per_second=10**9, header=EUROC),
    "EuRoC with velocities": dict(order="wxyz", separator=",", per_second=10**9, header=STATES, more=",0.1,0.2,0.3"),
    "VINS-Mono, no header": dict(order="wxyz", separator=",", per_second=10**9, more=","),
    "ORB-SLAM3, nanoseconds between blanks": dict(per_second=10**9),
    "table with a header, seconds": dict(order="wxyz", separator=", ", header="time, x, y, z, qw, qx, qy, qz"),
    "table with a header, w last": dict(separator=",", header="timestamp,tx,ty,tz,qx,qy,qz,qw"),
    "microseconds": dict(per_second=10**6, header="# timestamp tx ty tz qx qy qz qw"),
    "TUM with a covariance": dict(more=" 0.1 0.2 0.3"),
}


@pytest.mark.parametrize("kind", OF_STRANGERS)
def test_a_table_of_poses_is_read_as_its_columns_say(kind, tmp_path):
    Ts = hand_held()
    (tmp_path / "poses.txt").write_text(lines(Ts, **OF_STRANGERS[kind]))
    read = Trajectory.load(tmp_path / "poses.txt")
    np.testing.assert_allclose(read.timestamps, START + np.arange(len(Ts)) / 30, atol=2e-6)
    np.testing.assert_allclose(read.Ts_world_camera, Ts, atol=1e-7)


@pytest.mark.parametrize("rows", [3, 4])
def test_matrices_are_read_and_take_their_times_from_elsewhere(rows, tmp_path):
    Ts = hand_held()
    (tmp_path / "poses.txt").write_text(matrices(Ts, rows))
    (tmp_path / "true.txt").write_text(lines(Ts))
    with pytest.raises(DatasetError, match=r"holds 150 poses without times \(KITTI\)"):
        Trajectory.load(tmp_path / "poses.txt")
    times = START + np.arange(150) / 30
    read = Trajectory.load(tmp_path / "poses.txt", timestamps=times)
    np.testing.assert_allclose(read.Ts_world_camera, Ts, atol=1e-7)
    alone = evaluate(tmp_path / "poses.txt")
    assert alone.exit_code == 1
    assert "150 poses without times (KITTI); give --times FILE with 150 times, or --fps HZ" in alone.stderr
    (tmp_path / "times.txt").write_text("".join(f"{t:.6f}\n" for t in times))
    for more in ((), ("--times", tmp_path / "times.txt"), ("--times", tmp_path / "true.txt"), ("--fps", 30)):
        out = figures(tmp_path / "poses.txt", "--reference", tmp_path / "true.txt", *more)
        assert out["ate_rmse_m"] < 1e-6
        assert out["duration_s"] == pytest.approx(149 / 30, abs=1e-5)
        assert out["estimate_format"].startswith("KITTI, ")
    (tmp_path / "short.txt").write_text(matrices(Ts[:99], rows))
    refused = evaluate(tmp_path / "short.txt", "--reference", tmp_path / "true.txt")
    assert "99 poses without times (KITTI), and 150 times of the other trajectory do not fit" in refused.stderr
    refused = evaluate(tmp_path / "short.txt", "--times", tmp_path / "times.txt")
    assert "gives 150 times; expected one for each of 99 poses" in refused.stderr
    needless = evaluate(tmp_path / "true.txt", "--fps", 30)
    assert "found --fps; expected one of both" in needless.stderr
    assert "have their own times" in needless.stderr
    both = evaluate(tmp_path / "poses.txt", "--reference", tmp_path / "poses.txt")
    assert both.exit_code == 1
    assert figures(tmp_path / "poses.txt", "--reference", tmp_path / "poses.txt", "--fps", 10)["duration_s"] == 14.9


def test_frames_of_the_recording_are_the_times_of_matrices(tmp_path):
    """One pose for each frame, while the ground truth has its own rate."""
    folder, _ = write(tum, tmp_path)
    truth = Trajectory.load(folder / "groundtruth.txt")
    assert len(truth) == 3
    dense = np.linspace(truth.timestamps[0], truth.timestamps[-1], 41)
    Trajectory(dense, np.array([truth.interpolate(t) for t in dense])).save(folder / "groundtruth.txt")
    (tmp_path / "estimate.txt").write_text(matrices(truth.Ts_world_camera))
    out = figures(tmp_path / "estimate.txt", "--reference", folder)
    assert out["pairs"] == 3
    assert out["ate_rmse_m"] < 1e-3


def test_what_is_not_clear_is_refused_with_the_option_that_mends_it(tmp_path):
    Ts = hand_held()
    true = tmp_path / "true.txt"
    true.write_text(lines(Ts))
    unclear = tmp_path / "unclear.csv"
    for order, name in (("xyzw", "tum"), ("wxyz", "euroc")):
        unclear.write_text(lines(Ts, order, ","))
        refused = evaluate(unclear, "--reference", true)
        assert refused.exit_code == 1
        assert len(refused.stderr.splitlines()) == 1
        assert re.search(
            r"8 numbers a line, separated by commas, and no header.* give --format tum for", refused.stderr
        )
        assert figures(unclear, "--reference", true, "--format", name)["rotation_rmse_deg"] < 1e-3
        refused = evaluate(true, "--reference", unclear)
        assert "give --reference-format tum for" in refused.stderr
        assert figures(true, "--reference", unclear, "--reference-format", name)["rotation_rmse_deg"] < 1e-3
    cases = {
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 4 5 6\n2 1 0 0 0 5 6 7\n": "w x y z x y z",
        "".join(f"{k} {line}\n" for k, line in enumerate(matrices(Ts).splitlines())): "13 numbers a line",
        "1 2 3 4 5 6\n2 2 3 4 5 6\n": "expected 'timestamp tx ty tz qx qy qz qw', found '1 2 3 4 5 6'",
        "0 1 2 3 9 9 9 9\n1 1 2 3 9 9 9 9\n": "8 numbers a line, separated by blanks",
    }
    for text, sentence in cases.items():
        unclear.write_text(text)
        with pytest.raises(DatasetError, match=re.escape(sentence)):
            Trajectory.load(unclear)
    with pytest.raises(ConfigError, match="'bag'; expected one of tum, euroc, kitti"):
        Trajectory.load(true, format="bag")
    with pytest.raises(DatasetError, match=r"line 1: expected .*r11 r12 r13 tx"):
        Trajectory.load(true, format="kitti")


def test_rows_that_are_no_pose_are_left_out_and_counted(tmp_path):
    """As in the published ground truth of TUM fr2_desk, and as other systems mark lost frames."""
    rows = lines(hand_held()).splitlines(keepends=True)
    (tmp_path / "true.txt").write_text("".join(rows))
    (tmp_path / "doubled.txt").write_text("".join([*rows[:60], rows[59], *rows[60:]]))
    lost = "1403636581.77 nan nan nan nan nan nan nan\n"
    (tmp_path / "lost.txt").write_text("".join([*rows[:60], lost, *rows[62:]]))
    outcome = evaluate(tmp_path / "true.txt", "--reference", tmp_path / "doubled.txt")
    assert re.search(r"1 of 151 rows are left out; .* line 61: expected a time after 1403636581\.73", outcome.stderr)
    assert "150 of 150 estimated and 150 true" in outcome.stdout
    outcome = evaluate(tmp_path / "lost.txt", "--reference", tmp_path / "true.txt")
    assert "1 of 149 rows are left out; the first: " in outcome.stderr
    assert "148 of 148 estimated and 150 true" in outcome.stdout


@pytest.mark.parametrize(
    "ending", [name for name, known in EXPORTERS.items() if known.summary.startswith("trajectory")]
)
def test_every_exported_trajectory_is_evaluated_as_the_run_itself(ending, tmp_path):
    (tmp_path / "run").mkdir()
    true, found = hand_held(), hand_held(1, noise=0.02)
    Trajectory(100 + np.arange(150) / 30, found).save(tmp_path / "run" / "trajectory.txt")
    Trajectory(100 + np.arange(150) / 30, true).save(tmp_path / "groundtruth.txt")
    path = export_run(tmp_path / "run", tmp_path / f"exported{ending}")
    expected = figures(tmp_path / "run", "--reference", tmp_path / "groundtruth.txt")
    out = figures(path, "--reference", tmp_path / "groundtruth.txt")
    same = {key for key, value in expected.items() if isinstance(value, int | float)}
    assert {"ate_rmse_m", "rotation_rmse_deg", "rpe_rot_rmse_deg_per_s", "duration_s", "pairs"} <= same
    for key in same:
        assert out[key] == pytest.approx(expected[key], rel=1e-4, abs=1e-6), key


@pytest.mark.parametrize("kind", ["euroc", "kitti"])
def test_errors_of_other_formats_equal_those_of_evo(kind, tmp_path):
    """The reference is EuRoC's table or KITTI's matrices, the estimate TUM or KITTI, as evo wants it."""
    true, found = hand_held(), hand_held(1, noise=0.02)
    (tmp_path / "ref.txt").write_text(lines(true, **OF_STRANGERS["EuRoC"]) if kind == "euroc" else matrices(true))
    (tmp_path / "est.txt").write_text(lines(found) if kind == "euroc" else matrices(found))
    ours = figures(
        tmp_path / "est.txt", "--reference", tmp_path / "ref.txt", *(("--fps", "30") if kind == "kitti" else ())
    )

    def theirs(program, *arguments):
        results = tmp_path / "evo.zip"
        results.unlink(missing_ok=True)
        command = [Path(sys.executable).with_name(program), kind, "ref.txt", "est.txt", "--save_results", results]
        done = subprocess.run(
            [str(part) for part in (*command, *arguments)],
            cwd=tmp_path, env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLBACKEND": "Agg"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        with zipfile.ZipFile(results) as archive:
            return json.loads(archive.read("stats.json"))["rmse"]

    assert ours["ate_rmse_m"] == pytest.approx(theirs("evo_ape", "-a"), rel=1e-5)
    assert ours["ate_rot_rmse_deg"] == pytest.approx(theirs("evo_ape", "-a", "-r", "angle_deg"), rel=1e-5)
    turns = theirs("evo_rpe", "-d", "30", "-u", "f", "--all_pairs", "-r", "angle_deg")
    assert ours["rpe_rot_rmse_deg_per_s"] == pytest.approx(turns, rel=1e-5)


def test_marker_poses_of_bonn_become_camera_poses_and_camera_poses_stay(tmp_path):
    folder, _ = write(bonn, tmp_path)
    camera = hand_held()
    ros = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    mount = np.eye(4)
    U, _, Vt = np.linalg.svd([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    mount[:3, :3], mount[:3, 3] = U @ Vt, [0.0113, -0.0098, 0.0111]  # of the data set's script, without its scale
    published = "# ground truth trajectory\n" + lines(ros @ camera @ np.linalg.inv(mount) @ ros)
    (tmp_path / "estimate.txt").write_text(lines(hand_held(1, noise=0.01)))
    (folder / "groundtruth.txt").write_text(published)
    (tmp_path / "rgbd_bonn_crowd_gt.txt").write_text(published)
    (tmp_path / "other.txt").write_text(published)
    (tmp_path / "rgbd_bonn_copy").mkdir()
    (tmp_path / "rgbd_bonn_copy" / "groundtruth.txt").write_text(published)
    for more in (
        (folder,), (folder / "groundtruth.txt",), (tmp_path / "rgbd_bonn_crowd_gt.txt",),
        (tmp_path / "rgbd_bonn_copy",),
        (tmp_path / "other.txt", "--reference-format", "bonn"),
    ):  # fmt: skip
        out = figures(tmp_path / "estimate.txt", "--reference", *more)
        assert "marker poses converted to camera poses" in out["reference_format"]
        assert out["rpe_rot_rmse_deg_per_s"] < 2
        assert out["hints"] == []
    raw = figures(tmp_path / "estimate.txt", "--reference", folder / "groundtruth.txt", "--reference-format", "tum")
    assert raw["reference_format"] == "TUM"
    assert raw["rpe_rot_rmse_deg_per_s"] > 5
    assert "poses of another body than the camera" in raw["hints"][0]
    # files of dudmap in a folder of this name hold camera poses already
    Trajectory.load(tmp_path / "estimate.txt").save(folder / "groundtruth.txt")
    out = figures(tmp_path / "estimate.txt", "--reference", folder)
    assert out["ate_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert out["rotation_rmse_deg"] == pytest.approx(0, abs=1e-4)
