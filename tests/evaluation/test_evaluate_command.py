"""dudmap evaluate: the three forms, their JSON, their files, and one sentence for every mistake."""

import json
import re

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.viewing.run_files import RunFiles
from dudmap.cli import app
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.evaluation.files import find_reference, load_reference, tracked_share
from dudmap.evaluation.surface import moved
from dudmap.evaluation.trajectory import adjusted
from layout_images import pose, tum_line
from layouts import bonn, icl_nuim, mirrored, replica, write
from run_folders import write_run


def evaluate(*arguments):
    return CliRunner().invoke(app, ["evaluate", *(str(argument) for argument in arguments)])


def figures(*arguments):
    outcome = evaluate(*arguments, "--json")
    assert outcome.exit_code == 0, outcome.output
    assert len(outcome.stdout.splitlines()) == 1
    return json.loads(outcome.stdout)


def tetrahedron(shift=0.0):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) + np.float32(shift)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return Mesh(vertices, faces, np.full((4, 3), 90, np.uint8), np.eye(4, 3, dtype=np.float32))


@pytest.fixture
def folders(tmp_path):
    """A run of 50 of 60 frames and its recording: 1 cm of noise, another world frame, masks and meshes."""
    random = np.random.default_rng(2)
    stamps = np.arange(60) / 30
    waves = np.stack([np.sin((1 + 0.2 * k) * stamps + k) for k in range(6)], axis=1)
    true = Trajectory(stamps, np.array([se3.exp(0.6 * xi) for xi in waves]))
    first = se3.inverse(true.Ts_world_camera[0])
    noise = np.zeros((60, 4, 4))
    noise[1:, :3, 3] = random.normal(0, 0.01, (59, 3))
    run, recording = tmp_path / "run", tmp_path / "recording"
    (run / "masks").mkdir(parents=True)
    (recording / "mask").mkdir(parents=True)
    true.save(recording / "groundtruth.txt")
    Trajectory(stamps[:50], (first @ true.Ts_world_camera + noise)[:50]).save(run / "trajectory.txt")
    (recording / "depth.txt").write_text("".join(f"{t:.6f} depth/{t}.png\n" for t in stamps))
    tetrahedron().save(recording / "surface.ply")
    mesh = tetrahedron()
    Mesh(
        (mesh.vertices @ first[:3, :3].T + first[:3, 3]).astype(np.float32), mesh.faces, mesh.colors, mesh.normals
    ).save(run / "mesh.ply")
    mask = np.zeros((12, 16), np.uint8)
    mask[:6] = 255
    for t in stamps[:50]:
        cv2.imwrite(str(run / f"masks/{t:.6f}.png"), mask)
        cv2.imwrite(str(recording / f"mask/{t:.6f}.png"), 255 - mask if t > 1 else mask)
    (recording / "mask.txt").write_text("".join(f"{t:.6f} mask/{t:.6f}.png\n" for t in stamps[:50]))
    return run, recording


def test_trajectory_of_a_run(folders):
    run, recording = folders
    out = figures(run, "--reference", recording)
    assert out["ate_rmse_m"] == pytest.approx(0.01 * np.sqrt(3), rel=0.15)
    assert out["ate_mean_m"] < out["ate_rmse_m"] < out["ate_max_m"]
    assert out["rpe_trans_rmse_m_per_s"] == pytest.approx(0.01 * np.sqrt(6), rel=0.25)
    assert out["rpe_rot_rmse_deg_per_s"] < 1e-3
    assert out["rpe_trans_rmse_m_per_m"] is not None
    assert out["tracked_share"] == pytest.approx(50 / 60, abs=1e-5)
    assert out["alignment"] == "se3"
    assert json.loads((run / "evaluation.json").read_text()) == out
    (run / "metrics.json").write_text('{"frames": 100}')
    assert figures(run / "../run", "--reference", recording / "groundtruth.txt")["tracked_share"] == 0.5


def test_options_may_come_first_and_files_do(folders, tmp_path):
    run, recording = folders
    out = figures("--reference", recording, "--align", "origin", "--out", tmp_path / "scores", run / "trajectory.txt")
    assert out["alignment"] == "origin"
    assert out["ate_rmse_m"] == out["drift_rmse_m"]
    assert (tmp_path / "scores" / "trajectory.evaluation.json").is_file()


def test_without_a_reference_only_the_path_is_told(folders):
    run, recording = folders
    out = figures(run)
    assert out["reference"] is None
    assert out["tracked_share"] is None
    assert out["poses"] == 50
    assert "ate_rmse_m" not in out
    (run / "groundtruth.txt").write_text((recording / "groundtruth.txt").read_text())
    assert figures(run)["ate_rmse_m"] > 0


def test_mesh_of_a_run_is_moved_into_the_true_world(folders):
    run, recording = folders
    out = figures("mesh", run, recording, "--samples", 2000)
    assert out["accuracy_rmse_m"] < 1e-3
    assert out["f_score_10mm"] == 1
    assert out["ghost_area_m2"] == 0
    assert len(out["histogram"]["accuracy"]) + 1 == len(out["histogram"]["edges_m"])
    assert len(Mesh.load(run / "mesh_error.ply").faces) == 4
    apart = figures("mesh", run / "mesh.ply", recording / "surface.ply", "--samples", 2000, "--no-error-mesh")
    assert apart["accuracy_rmse_m"] > 0.1
    aligned = figures("mesh", run, recording, "--register", "--samples", 2000, "--distances", "0.002")
    assert aligned["icp_rmse_m"] < 1e-3
    assert aligned["precision_2mm"] > 0.99


def test_a_mesh_is_compared_with_the_model_of_icl_nuim(tmp_path):
    """Table 5.1: the model has axes of its own, and poses in it that the page of the data set publishes."""
    folder, _ = write(icl_nuim, tmp_path / "data")
    model_world = se3.exp(np.array([0.7, -1.2, 0.4, 0.5, 2.0, -0.3]))
    x, y = np.diag([-1.0, 1, 1, 1]), np.diag([1.0, -1, 1, 1])
    frames = (1, 2, 3)
    (folder / "livingRoom2.gt.freiburg").write_text("".join(tum_line(k, mirrored(pose(k))) for k in frames))
    rows = [x @ model_world @ pose(k) @ y for k in frames]
    (folder / "livingRoom2.gt.sim").write_text(
        "\n".join("\n".join(" ".join(f"{v:.6f}" for v in row) for row in T[:3]) + "\n" for T in rows)
    )
    mesh = tetrahedron()
    moved(mesh, model_world).save(folder.parent / "living-room.ply")
    run = tmp_path / "run"
    run.mkdir()
    first = se3.inverse(pose(1))
    moved(mesh, first).save(run / "mesh.ply")
    Trajectory(np.array(frames) / 30, np.array([first @ pose(k) for k in frames])).save(run / "trajectory.txt")
    out = figures("mesh", run, folder, "--samples", 2000)
    assert out["reference"] == str(folder.parent / "living-room.ply")
    assert max(out["accuracy_mean_m"], out["completeness_mean_m"]) < 1e-4
    (folder / "livingRoom2.gt.sim").unlink()
    refused = evaluate("mesh", run, folder)
    assert refused.exit_code == 1
    assert re.search(r"^dudmap: .*living-room.ply cannot be placed: .* 0 files \*\.gt\.sim", refused.stderr)


def test_masks_of_a_run(folders):
    run, recording = folders
    out = figures("masks", run, recording, "--per-frame")
    right = 31  # 0 to 1 s
    assert out["mean_iou"] == pytest.approx(right / 50)
    assert out["overall_iou"] == pytest.approx(right / (50 + 50 - right))
    assert out["scored_frames"] == 50
    assert len(out["per_frame"]["iou"]) == 50
    assert json.loads((run / "masks.evaluation.json").read_text()) == out


def test_pictures(folders):
    run, recording = folders
    edges = np.linspace(0, 16, 129)
    np.savez(run / "residuals.npz", edges=edges, counts=np.arange(128)[::-1], prior=[0.8, 0.2], sigma=[1.0, 6.0])
    outcome = evaluate(run, "--reference", recording, "--plots")
    assert outcome.exit_code == 0, outcome.output
    assert re.search(r"ate_rmse +│ [\d.]+ mm", outcome.stdout)
    assert evaluate("mesh", run, recording, "--plots", "--samples", 2000).exit_code == 0
    assert evaluate("masks", run, recording, "--plots").exit_code == 0
    assert evaluate("masks", run, recording, "--plot-format", "pdf").exit_code == 0
    assert (run / "masks.pdf").read_bytes().startswith(b"%PDF")
    assert evaluate(run, "--reference", recording, "--plot-format", "svg").exit_code == 0
    assert "<svg" in (run / "trajectory.svg").read_text(encoding="utf-8")
    for name in ("trajectory", "error", "path", "rpe", "residuals", "mesh_error", "masks"):
        image = cv2.imread(str(run / f"{name}.png"))
        assert image is not None, name
        assert image.std() > 10, name


def test_mistakes_are_one_sentence(folders, tmp_path):
    run, recording = folders
    (tmp_path / "empty").mkdir()
    (tmp_path / "nan.txt").write_text("0 nan 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n")
    (tmp_path / "broken.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n")
    cases = [
        ((tmp_path / "empty", "--reference", recording), "holds no trajectory.txt"),
        ((tmp_path / "none.txt", "--reference", recording), "cannot read"),
        ((run, "--reference", recording, "--format", "latex"), "the table takes --table-format latex"),
        ((tmp_path / "nan.txt", "--reference", recording), "line 1: expected eight finite numbers"),
        ((run, "--reference", tmp_path / "empty"), "there is no true trajectory"),
        ((run, "--reference", recording, "--align", "sim3"), "expected one of se3, origin, none"),
        ((run, "--plots"), "name one with --reference"),
        ((run, "--plot-format", "gif"), "found --plot-format gif; expected png, pdf or svg"),
        ((run, "--table-format", "tex"), "found --table-format tex; expected one of md, csv, latex"),
        ((run, run), "several estimates need one reference; name it with --reference"),
        ((run, run, "--reference", recording), "found two estimates with the name run; name them by NAME=PATH"),
        (("mesh", tmp_path / "empty", recording), "there is no mesh"),
        (("mesh", tmp_path / "broken.ply", recording), "cannot read the mesh"),
        (("mesh", run, recording, "--distances", "1cm"), "expected numbers separated by commas"),
        (("mesh", run, recording, "--ghost-distance", "0"), "expected a positive number"),
        (("masks", tmp_path / "empty", recording), "run with --save-masks"),
    ]
    for arguments, sentence in cases:
        outcome = evaluate(*arguments)
        assert outcome.exit_code == 1, arguments
        assert sentence in outcome.stderr, arguments
        assert outcome.stderr.startswith("dudmap: ")
        assert len(outcome.stderr.strip().splitlines()) == 1


def test_help_names_all_three():
    for name in ("trajectory", "mesh", "masks"):
        assert name in evaluate("--help").stdout
        assert "--json" in evaluate(name, "--help").stdout


def test_help_shows_the_options_of_the_form_without_a_word():
    for option in ("--reference", "--plots", "--align", "--table-format", "--time-offset"):
        assert option in evaluate("--help").stdout


def test_the_truth_of_a_recording_is_read_as_its_format_stores_it(tmp_path):

    for layout, stamps in ((bonn, [100, 100.1, 100.2]), (replica, [0, 1 / 30, 2 / 30])):
        folder, _ = write(layout, tmp_path / layout.__name__)
        found = find_reference(folder, None)
        assert found is not None
        np.testing.assert_allclose(load_reference(found).Ts_world_camera, [pose(k) for k in range(3)], atol=1e-6)
        assert tracked_share(2, None, found) == pytest.approx(2 / 3, abs=1e-6)
        estimate = tmp_path / f"{layout.__name__}.txt"
        estimate.write_text("".join(tum_line(f"{t:.6f}", pose(k)) for k, t in enumerate(stamps)))
        assert figures(estimate, "--reference", folder)["ate_rmse_m"] == pytest.approx(0, abs=1e-5)


def test_errors_are_printed_in_millimetres():
    from dudmap.cli.evaluate import _shown

    assert _shown("ate_rmse_m", 0.00745755) == ("ate_rmse", "7.5 mm")
    assert _shown("rpe_trans_rmse_m_per_s", 0.0123) == ("rpe_trans_rmse per s", "12.3 mm")
    assert _shown("path_length_m", 3.25) == ("path_length_m", "3.25")
    assert _shown("rpe_rot_rmse_deg_per_m", 0.7146) == ("rpe_rot_rmse per m", "0.71 deg")
    assert _shown("ate_rot_rmse_deg", 2.7328) == ("ate_rot_rmse (see rotation_rmse)", "2.73 deg")


def test_times_per_stage_are_a_table_for_a_paper(tmp_path):
    write_run(tmp_path / "run")
    figures = json.loads(evaluate("timings", tmp_path / "run", "--json").stdout)
    columns = RunFiles.load(tmp_path / "run")
    for stage in ("total", *columns.stages):
        assert figures[f"{stage}_median_ms"] == pytest.approx(np.median(columns.column(stage)), abs=1e-3)
        assert figures[f"{stage}_p95_ms"] == pytest.approx(np.percentile(columns.column(stage), 95), abs=1e-3)
    rows = (tmp_path / "run" / "timings.tex").read_text(encoding="utf-8").splitlines()
    assert rows[4].startswith(f"total & {figures['total_median_ms']:.1f} & ")
    assert len(rows) == 5 + len(columns.stages) + 2
    shown = evaluate("timings", tmp_path / "run").stdout.splitlines()
    assert shown[0] == "| stage | median, ms | mean, ms | 95 %, ms |"
    assert shown[2].startswith(f"| total | {figures['total_median_ms']:.1f} | ")


def test_a_missing_file_is_told_without_the_words_of_the_system(tmp_path):
    missing = tmp_path / "none.txt"
    assert evaluate(missing).stderr == f"dudmap: cannot read {missing}: No such file or directory\n"


def test_scale_and_time_offset_of_a_run(folders, tmp_path):
    run, recording = folders
    plain = figures(run, "--reference", recording)
    found = Trajectory.load(run / "trajectory.txt")
    adjusted(found, 7.25, 0.4).save(tmp_path / "other.txt")
    refused = evaluate(tmp_path / "other.txt", "--reference", recording)
    assert refused.exit_code == 1
    assert re.search("^dudmap: 0 of 50 .* give --time-offset auto", refused.stderr)
    out = figures(tmp_path / "other.txt", "--reference", recording, "--time-offset", "auto", "--scale")
    assert out["time_offset_s"] == pytest.approx(-7.25, abs=0.005)
    assert out["scale"] == pytest.approx(2.5, rel=0.01)
    assert out["ate_rmse_m"] == pytest.approx(plain["ate_rmse_m"], rel=0.02)
    given = figures(tmp_path / "other.txt", "--reference", recording, "--time-offset", "-7.25", "--scale")
    assert given["ate_rmse_m"] == pytest.approx(plain["ate_rmse_m"], rel=0.02)
    outcome = evaluate(run, "--reference", recording, "--time-offset", "0.2")
    assert "50 of 50 estimated and 60 true poses" in outcome.stdout
    assert re.search(r"hint: the clocks seem to differ: with -0\.[12]\d+ s .*--time-offset auto", outcome.stdout)


@pytest.fixture
def several(folders, tmp_path):
    """Options for the run, its copy without the frames of 0.5 to 1 s under another name, and the reference."""
    run, recording = folders
    found = Trajectory.load(run / "trajectory.txt")
    kept = (found.timestamps < 0.5) | (found.timestamps > 1)
    Trajectory(found.timestamps[kept], found.Ts_world_camera[kept]).save(tmp_path / "a=b_1.txt")
    return run, f"with % gaps={tmp_path / 'a=b_1.txt'}", "--reference", recording, "--out", tmp_path / "out"


def test_several_estimates_are_one_table(folders, several, tmp_path):
    out = figures(*several)
    alone = figures(folders[0], "--reference", folders[1])
    first, second = out["estimates"]
    assert first == {"name": "run"} | alone
    assert second["name"] == "with % gaps"
    assert second["pairs"] == 34
    assert first["covered_share"] == pytest.approx(49 / 59)
    assert second["covered_share"] == pytest.approx((49 - 17) / 59)
    assert json.loads((tmp_path / "out/evaluation.json").read_text()) == out
    table = evaluate(*several)
    assert table.stdout == (tmp_path / "out/evaluation.md").read_text()
    head, _, row, _ = table.stdout.splitlines()
    assert head.startswith("| method | ATE RMSE, mm |")
    assert row.startswith(f"| run | {1000 * alone['ate_rmse_m']:.1f} |")
    assert not (folders[0] / "evaluation.md").exists()
    named = evaluate(tmp_path / "a=b_1.txt", *several[:1], *several[2:])
    assert named.stdout.splitlines()[2].startswith("| a=b_1 |")


def test_table_for_a_paper(several, tmp_path):
    table = evaluate(*several, "--table-format", "latex").stdout
    assert table == (tmp_path / "out/evaluation.tex").read_text()
    lines = table.splitlines()
    assert lines[:2] == [r"\begin{tabular}{lrrrrrrr}", r"\toprule"]
    assert lines[2].endswith(r"& covered, \% \\")
    assert lines[5].startswith(r"with \% gaps & ")
    assert {line.count("&") for line in lines[2:6]} == {0, 7}
    assert lines[-2:] == [r"\bottomrule", r"\end{tabular}"]


def test_several_estimates_are_in_one_plot(several, tmp_path):
    assert evaluate(*several, "--plot-format", "svg").exit_code == 0
    for name in ("trajectory", "error", "path", "rpe"):
        text = (tmp_path / f"out/{name}.svg").read_text(encoding="utf-8")
        assert all(f"<!-- {label}: " in text for label in ("run", "with % gaps")), name


def test_estimates_without_common_times_are_named(several, tmp_path):
    run, named, *rest = several
    late = adjusted(Trajectory.load(run / "trajectory.txt"), 7.25)
    for name in ("late", "later"):
        late.save(tmp_path / f"{name}.txt")
    refused = evaluate(run, tmp_path / "late.txt", named, tmp_path / "later.txt", *rest)
    assert refused.exit_code == 1
    reason = "0 of 50 estimated poses .* give --time-offset auto if both are of one recording"
    assert re.fullmatch(f"dudmap: late: {reason}; later: {reason}\n", refused.stderr)
    rows = figures(run, tmp_path / "late.txt", *rest, "--time-offset", "auto")["estimates"]
    assert rows[1]["time_offset_s"] == pytest.approx(-7.25, abs=0.005)
    assert rows[1]["ate_rmse_m"] == pytest.approx(rows[0]["ate_rmse_m"], rel=0.02)
