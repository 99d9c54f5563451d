"""Trajectory errors against exact motions, a plain transcription of the definition, and evo as a separate program."""

import csv
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
from dudmap.evaluation.hints import hints
from dudmap.evaluation.time_offset import MotionComparison
from dudmap.evaluation.trajectory import adjusted, ate, fit_scale, pair_poses, rpe

RNG_SEED = 7


def hand_held(frames=120, fps=30.0, seed=RNG_SEED):
    """A smooth path with translation and rotation in all directions."""
    t = np.arange(frames) / fps
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 6)
    xi = np.stack([0.8 * np.sin(0.9 * t * (1 + 0.3 * k) + phase[k]) for k in range(6)], axis=1)
    return Trajectory(t, np.array([se3.exp(row) for row in xi]))


def disturbed(reference, translation=0.02, rotation=0.01, seed=1):
    """Noise on every pose, in another world frame, at times that are a little off."""
    random = np.random.default_rng(seed)
    noise = random.normal(0, 1, (len(reference), 6)) * ([translation] * 3 + [rotation] * 3)
    world = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, 1.2, -0.7]))
    Ts = np.array([world @ T @ se3.exp(xi) for T, xi in zip(reference.Ts_world_camera, noise, strict=True)])
    return Trajectory(reference.timestamps + random.uniform(-0.004, 0.004, len(reference)), Ts)


def test_another_world_frame_is_no_error():
    reference = hand_held()
    world = se3.exp(np.array([3.0, 1.0, -2.0, 0.5, -1.0, 2.0]))
    result = ate(Trajectory(reference.timestamps, world @ reference.Ts_world_camera), reference)
    assert result.alignment == "se3"
    assert result.num_pairs == len(reference)
    assert max(result.trans.max, result.rot_deg.max) < 1e-6
    np.testing.assert_allclose(result.T_reference_estimate, se3.inverse(world), atol=1e-9)
    unaligned = ate(Trajectory(reference.timestamps, world @ reference.Ts_world_camera), reference, align="none")
    assert unaligned.rmse > 1
    assert unaligned.rot_deg.mean == pytest.approx(np.degrees(se3.rotation_angle(world)), abs=1e-6)


def test_known_offset_of_half_of_the_poses():
    """Every second pose is 2 cm off along x: after alignment each is 1 cm off, and each turn of 3 degrees stays."""
    reference = hand_held()
    Ts = reference.Ts_world_camera.copy()
    Ts[:, 0, 3] += 0.02 * (np.arange(len(Ts)) % 2)
    turn = se3.exp(np.array([0, 0, 0, 0, 0, np.radians(3.0)]))
    result = ate(Trajectory(reference.timestamps, Ts @ turn), reference)
    assert result.rmse == pytest.approx(0.01, rel=0.02)
    assert result.trans.median == pytest.approx(0.01, rel=0.05)
    assert result.rot_deg.rmse == pytest.approx(3.0, abs=0.1)
    fixed = ate(Trajectory(reference.timestamps, Ts), reference, align="origin")
    np.testing.assert_allclose(fixed.trans_errors, 0.02 * (np.arange(len(Ts)) % 2), atol=1e-12)


def test_poses_are_paired_one_to_one_and_nearest_first():
    eye = np.eye(4)
    estimate = Trajectory(np.array([0.0, 0.1, 0.105, 0.2, 0.5]), np.tile(eye, (5, 1, 1)))
    reference = Trajectory(
        np.array([0.001, 0.104, 0.3, 0.35, 0.219, 0.516])[[0, 1, 4, 2, 3, 5]], np.tile(eye, (6, 1, 1))
    )
    pairs = pair_poses(estimate, reference)
    assert pairs.timestamps.tolist() == [0.0, 0.105, 0.2, 0.5]
    assert len(pair_poses(estimate, reference, 0.018).timestamps) == 3


def test_fixed_camera_takes_its_rotation_from_the_orientations():
    frames = 60
    reference = Trajectory(np.arange(frames) / 30, np.tile(np.eye(4), (frames, 1, 1)))
    drift = np.array([se3.exp(np.array([0.001 * k, 0, 0, 0, 0.0005 * k, 0])) for k in range(frames)])
    result = ate(Trajectory(reference.timestamps, drift), reference, align="se3")
    assert result.alignment == "se3-orientations"
    assert result.rot_deg.max == pytest.approx(np.degrees(0.0005 * frames / 2), rel=0.05)
    start = ate(Trajectory(reference.timestamps, drift), reference, align="origin")
    assert start.trans.max == pytest.approx(0.001 * (frames - 1), rel=1e-3)
    assert start.rot_deg.max == pytest.approx(np.degrees(0.0005 * (frames - 1)), rel=1e-3)


@pytest.mark.parametrize("turning", [True, False])
def test_turning_camera_and_rail_in_another_world_frame(turning):
    frames = 90
    if turning:
        xi = [[0, 0, 0, 0.1 * np.sin(k / 9), 0.02 * k, 0] for k in range(frames)]
    else:
        xi = [[0.01 * k, 0, 0, 0, 0, 0] for k in range(frames)]
    reference = Trajectory(np.arange(frames) / 10, np.array([se3.exp(np.array(row)) for row in xi]))
    world = se3.exp(np.array([1.0, 2.0, 3.0, 0.7, -0.4, 1.1]))
    result = ate(Trajectory(reference.timestamps, world @ reference.Ts_world_camera), reference)
    assert result.alignment == "se3-orientations"
    assert max(result.trans.max, result.rot_deg.max) < 1e-6


@pytest.mark.parametrize(("delta", "unit"), [(1.0, "s"), (0.5, "m")])
def test_relative_error_is_that_of_the_definition(delta, unit):
    """Transcribed with scipy's rotations and plain loops; time stamps are regular so that every pair is exact."""
    reference = hand_held(150)
    noisy = disturbed(reference)
    estimate = Trajectory(reference.timestamps, noisy.Ts_world_camera)
    P = reference.Ts_world_camera[:, :3, 3]
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(P, axis=0), axis=1))])
    translations, angles = [], []
    for i in range(150):
        if unit == "m":
            j = int(np.argmin(np.abs(path - path[i] - delta)))
            if abs(path[j] - path[i] - delta) > 0.1 * delta:
                continue
        else:
            j = i + 30
        if j > 149:
            continue
        Q = np.linalg.inv(reference.Ts_world_camera[i]) @ reference.Ts_world_camera[j]
        E = np.linalg.inv(Q) @ np.linalg.inv(estimate.Ts_world_camera[i]) @ estimate.Ts_world_camera[j]
        translations.append(np.linalg.norm(E[:3, 3]))
        angles.append(np.degrees(Rotation.from_matrix(E[:3, :3]).magnitude()))
    result = rpe(estimate, reference, delta, unit)
    np.testing.assert_allclose(result.trans_errors, translations, atol=1e-9)
    np.testing.assert_allclose(result.rot_errors_deg, angles, atol=1e-6)
    assert result.trans.rmse == pytest.approx(np.sqrt(np.mean(np.square(translations))))


def test_on_a_recording_without_gaps_the_rule_of_the_tum_script_gives_the_same():
    """Nearest pose one second on, nearest true pose of each, and no pair that ends at the last pose."""
    reference = hand_held(600, 100.0)
    true = Trajectory(reference.timestamps[::3], reference.Ts_world_camera[::3])
    estimate = disturbed(true)
    t, errors = estimate.timestamps, []
    for i in range(len(t)):
        j = int(np.argmin(np.abs(t - (t[i] + 1.0))))
        if j == len(t) - 1:
            continue
        a, b = (reference.Ts_world_camera[np.argmin(np.abs(reference.timestamps - t[k]))] for k in (i, j))
        moved = np.linalg.inv(estimate.Ts_world_camera[i]) @ estimate.Ts_world_camera[j]
        errors.append(np.linalg.norm((np.linalg.inv(moved) @ np.linalg.inv(a) @ b)[:3, 3]))
    result = rpe(estimate, reference)
    np.testing.assert_allclose(result.trans_errors[: len(errors)], errors, atol=1e-9)
    assert result.num_pairs - len(errors) in (0, 1)


def test_constant_drift_per_second_and_no_pair_across_a_gap():
    """1 cm/s of drift along a straight path gives 1 cm for every second, with or without 3 s of lost frames."""
    t = np.arange(300) / 30
    Ts = np.tile(np.eye(4), (300, 1, 1))
    Ts[:, 0, 3] = 0.2 * t
    drifting = Ts.copy()
    drifting[:, 1, 3] = 0.01 * t
    keep = (t < 3) | (t >= 6)
    result = rpe(Trajectory(t[keep], drifting[keep]), Trajectory(t, Ts))
    np.testing.assert_allclose(result.trans_errors, 0.01, rtol=0.02)
    assert result.num_pairs == 60 + 90
    per_metre = rpe(Trajectory(t, drifting), Trajectory(t, Ts), 1.0, "m")
    np.testing.assert_allclose(per_metre.trans_errors, 0.05, rtol=0.11)


def test_errors_are_one_sentence():
    reference = hand_held(20)
    late = Trajectory(reference.timestamps + 100, reference.Ts_world_camera)
    with pytest.raises(
        DatasetError,
        match=r"0 of 20 .* within 20 ms of a pose of the reference \(0\.000 to 0\.633 s.*--time-offset auto",
    ):
        ate(late, reference)
    with pytest.raises(DatasetError, match="2 of 2 estimated poses"):
        ate(Trajectory(reference.timestamps[:2], reference.Ts_world_camera[:2]), reference)
    with pytest.raises(DatasetError, match="holds no pose"):
        ate(Trajectory(np.empty(0), np.empty((0, 4, 4))), reference)
    with pytest.raises(DatasetError, match=r"no two poses are 1 s apart; the compared part is 0\.633 s long"):
        rpe(reference, reference)
    with pytest.raises(DatasetError, match="NaN"):
        Trajectory(reference.timestamps, reference.Ts_world_camera * np.nan)
    with pytest.raises(ConfigError, match="expected one of se3, origin, none"):
        ate(reference, reference, align="sim3")
    with pytest.raises(ConfigError, match="a positive number of s or m"):
        rpe(reference, reference, -1.5, "m")


# -- evo, as a separate program ---------------------------------------------------------------------------------------


def evo(program, tmp_path, *arguments):
    """Statistics that a program of evo writes for est.txt against ref.txt."""
    script = Path(sys.executable).with_name(program)
    if not script.is_file():
        pytest.fail(f"{program} is not installed beside {sys.executable}; the dev extra brings it")
    results = tmp_path / f"{program}.zip"
    results.unlink(missing_ok=True)
    command = [script, "tum", "ref.txt", "est.txt", "--t_max_diff", "0.02", "--save_results", results, *arguments]
    done = subprocess.run(
        [str(part) for part in command],
        cwd=tmp_path,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(results) as archive:
        return json.loads(archive.read("stats.json"))


@pytest.fixture
def files(tmp_path):
    reference = hand_held(150)
    disturbed(reference).save(tmp_path / "est.txt")
    reference.save(tmp_path / "ref.txt")
    return Trajectory.load(tmp_path / "est.txt"), Trajectory.load(tmp_path / "ref.txt")


@pytest.mark.parametrize(("align", "flags"), [("se3", ["-a"]), ("origin", ["--align_origin"]), ("none", [])])
def test_absolute_error_equals_that_of_evo(align, flags, files, tmp_path):
    ours = ate(*files, align=align)
    theirs = evo("evo_ape", tmp_path, *flags)
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours.trans, name) == pytest.approx(theirs[name], rel=1e-6), name
    theirs = evo("evo_ape", tmp_path, *flags, "-r", "angle_deg")
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours.rot_deg, name) == pytest.approx(theirs[name], rel=1e-5), name


@pytest.mark.parametrize(
    ("delta", "unit", "flags"),
    [(1.0, "s", ["-d", "30", "-u", "f"]), (0.5, "m", ["-d", "0.5", "-u", "m", "--pairs_from_reference"])],
)
def test_relative_error_equals_that_of_evo(delta, unit, flags, files, tmp_path):
    """evo knows no seconds: at 30 Hz one second is 30 frames."""
    ours = rpe(*files, delta, unit)
    for name, relation in (("trans", "trans_part"), ("rot_deg", "angle_deg")):
        theirs = evo("evo_rpe", tmp_path, *flags, "--all_pairs", "-r", relation)
        assert getattr(ours, name).rmse == pytest.approx(theirs["rmse"], rel=1e-5)
        assert getattr(ours, name).max == pytest.approx(theirs["max"], rel=1e-5)


def test_scale_and_errors_of_a_scaled_estimate_equal_those_of_evo(files, tmp_path):
    """Sim(3) alignment of a monocular estimate; evo prints the scale it corrects."""
    adjusted(files[0], scale=0.13).save(tmp_path / "est.txt")
    estimate = Trajectory.load(tmp_path / "est.txt")
    scale = fit_scale(estimate, files[1])
    assert scale == pytest.approx(1 / 0.13, rel=0.01)
    scaled = adjusted(estimate, scale=scale)
    for align, flags in (("se3", ["-a"]), ("origin", ["--align_origin"]), ("none", [])):
        theirs = evo("evo_ape", tmp_path, *flags, "--correct_scale")
        assert ate(scaled, files[1], align).rmse == pytest.approx(theirs["rmse"], rel=1e-6), align
    theirs = evo("evo_rpe", tmp_path, "-a", "--correct_scale", "-d", "30", "-u", "f", "--all_pairs")
    assert rpe(scaled, files[1]).rmse == pytest.approx(theirs["rmse"], rel=1e-5)
    fixed = Trajectory(files[1].timestamps, np.tile(np.eye(4), (len(files[1]), 1, 1)))
    with pytest.raises(DatasetError, match="do not determine a scale"):
        fit_scale(fixed, files[1])


def test_errors_at_a_time_offset_equal_those_of_evo(files, tmp_path):
    adjusted(files[0], -12.345).save(tmp_path / "est.txt")
    estimate = Trajectory.load(tmp_path / "est.txt")
    found = MotionComparison(estimate, files[1]).best().seconds
    assert found == pytest.approx(12.345, abs=0.01)  # noise of 2 cm and 0.6 deg on every pose
    theirs = evo("evo_ape", tmp_path, "-a", "--t_offset", f"{found:.6f}")
    assert ate(adjusted(estimate, round(found, 6)), files[1]).rmse == pytest.approx(theirs["rmse"], rel=1e-5)


# -- clocks and bodies ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.173, -4.2, 1403636579.763])
@pytest.mark.parametrize("body", [np.eye(4), se3.exp(np.array([0.1, -0.2, 0.05, 1.2, -0.4, 2.0]))])
def test_time_offset_is_found_whatever_world_body_scale_and_rate(offset, body):
    reference = hand_held(900)
    estimate = disturbed(Trajectory(reference.timestamps[200:600:3], reference.Ts_world_camera[200:600:3] @ body))
    found = MotionComparison(adjusted(estimate, -offset, 0.2), reference).best()
    assert found.seconds == pytest.approx(offset, abs=0.005)
    assert found.unexplained < 0.05


def test_time_offset_of_a_camera_that_only_turns_is_found_by_its_rotations():
    t = np.arange(300) / 30
    angles = 0.5 * np.sin(t) + 0.3 * np.sin(2.3 * t + 1)
    Ts = np.array([se3.exp(np.array([0, 0, 0, 0, angle, 0])) for angle in angles])
    found = MotionComparison(Trajectory(t[50:250] + 0.4, Ts[50:250]), Trajectory(t, Ts)).best()
    assert found.seconds == pytest.approx(-0.4, abs=0.002)


def test_no_time_offset_is_invented():
    reference = hand_held(300)
    fixed = Trajectory(reference.timestamps, np.tile(np.eye(4), (300, 1, 1)))
    with pytest.raises(DatasetError, match="does not move; give --time-offset SECONDS"):
        MotionComparison(fixed, fixed).best()
    with pytest.raises(DatasetError, match="fewer than half"):
        MotionComparison(reference, Trajectory(reference.timestamps[:50], reference.Ts_world_camera[:50])).best()


def test_another_clock_and_another_body_are_hinted_at_and_noise_is_not():
    reference = hand_held(600)
    estimate = disturbed(reference, translation=0.01)
    assert hints(estimate, reference, 0.02) == []
    (clock,) = hints(adjusted(estimate, 0.3), reference, 0.02)
    assert re.search(r"with -0\.(299|30\d) s .* --time-offset auto", clock)
    turn = se3.exp(np.array([0.02, 0, 0.01, *(np.radians(133) * np.array([0.6, 0, 0.8]))]))
    (other,) = hints(estimate, Trajectory(reference.timestamps, reference.Ts_world_camera @ turn), 0.02)
    assert "turned by 133 deg" in other


def test_too_few_matches_are_refused_with_the_option_that_mends_them():
    reference = hand_held(300)
    sparse = Trajectory(reference.timestamps[::30], reference.Ts_world_camera[::30])
    assert ate(reference, sparse).num_pairs == 10  # every pose of the sparser one
    half = Trajectory(reference.timestamps[::3], reference.Ts_world_camera[::3])
    with pytest.raises(DatasetError, match=r"^0 of 100 .* a larger --max-difference, or --time-offset auto"):
        ate(adjusted(half, 0.05), half)
    with pytest.raises(DatasetError, match=r"^9 of 300 .*at least 30 are needed: give a larger --max-difference"):
        ate(adjusted(reference, reference.timestamps[-1] - 8 / 30), reference)


def test_table_of_several_estimates_equals_evo(files, tmp_path):
    """Each row of the command's CSV against evo on the same file, at the file's own noise."""
    for name, seed in (("one", 3), ("two", 4)):
        disturbed(files[1], seed=seed).save(tmp_path / f"{name}.txt")
    arguments = [f"first={tmp_path / 'one.txt'}", tmp_path / "two.txt", "--reference", tmp_path / "ref.txt"]
    arguments += ["--table-format", "csv", "--out", tmp_path / "out"]
    done = CliRunner().invoke(app, ["evaluate", *map(str, arguments)])
    assert done.exit_code == 0, done.output
    rows = list(csv.DictReader(done.stdout.splitlines()))
    assert [row["name"] for row in rows] == ["first", "two"]
    for row, name in zip(rows, ("one", "two"), strict=True):
        (tmp_path / "est.txt").write_text((tmp_path / f"{name}.txt").read_text())
        theirs = evo("evo_ape", tmp_path, "-a")
        for key in ("rmse", "mean", "median", "max"):
            assert float(row[f"ate_{key}_m"]) == pytest.approx(theirs[key], rel=1e-6)
        for key, relation in (("trans_rmse_m", "trans_part"), ("rot_rmse_deg", "angle_deg")):
            theirs = evo("evo_rpe", tmp_path, "-d", "30", "-u", "f", "--all_pairs", "-r", relation)
            assert float(row[f"rpe_{key}_per_s"]) == pytest.approx(theirs["rmse"], rel=1e-5)
