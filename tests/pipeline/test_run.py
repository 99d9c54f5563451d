"""The run folder, and that what was computed is written whatever happens. The algorithm is replaced by a stand-in."""

import csv
import json
import logging

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.frame_source import read_ahead
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, DudmapError
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.sequences import open_sequence
from fake_slam import SECOND, FakeVolume
from layouts import corbs, replica, write
from recordings import HEIGHT, WIDTH, cut, write_recording


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "desk", 8)


def go(recording, out, **options):
    return run(open_sequence(recording), Config(), out, progress=False, **options)


def metrics_of(out):
    return json.loads((out / "metrics.json").read_text())


def test_the_run_folder(slam, recording, tmp_path):
    slam.script = {2: "lost", 5: "similar"}
    out = tmp_path / "deep" / "out"
    report = go(recording, out)
    assert sorted(path.name for path in out.iterdir()) == [
        "calibration.toml", "checks.csv", "config.toml", "keyframes.npz", "map.npz", "mesh.ply", "metrics.json",
        "movers.jsonl", "timings.csv", "trajectory.txt",
    ]  # fmt: skip
    metrics = metrics_of(out)
    assert metrics == json.loads(json.dumps(report.metrics))
    expected = {
        "sequence": "desk", "complete": True, "frames": 8, "tracked": 7, "fused": 6, "skipped_similar": 1, "lost": 1,
        "unreadable": 0, "map_blocks": 3, "map_bytes": 12345, "mesh_vertices": 3, "mesh_triangles": 1,
        "lost_frames": [{"timestamp": 100.2, "reason": "too few inliers"}],
    }  # fmt: skip
    assert {key: metrics[key] for key in expected} == expected
    for key in ("ms_per_frame_median", "ms_per_frame_p95", "ms_reading_median", "cpu_s", "wall_s", "peak_rss_mb"):
        assert metrics[key] >= 0
    assert "ate_rmse_m" not in metrics
    assert {"dudmap", "python", "numpy", "numba", "opencv"} <= set(metrics["versions"])
    assert {"cpu", "cores", "os"} <= set(metrics["machine"])
    trajectory = Trajectory.load(out / "trajectory.txt")
    np.testing.assert_allclose(trajectory.timestamps, 100 + 0.1 * np.array([0, 1, 3, 4, 5, 6, 7]))
    np.testing.assert_allclose(trajectory.Ts_world_camera[:, 0, 3], 0.01 * np.array([0, 1, 3, 4, 5, 6, 7]))
    assert Config.load(out / "config.toml") == Config()
    assert len(Mesh.load(out / "mesh.ply").faces) == 1
    with (out / "timings.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["timestamp"] for row in rows] == [f"{100 + 0.1 * k:.6f}" for k in range(8)]
    assert rows[2]["state"] == "lost"
    assert float(rows[2]["track"]) == 2.0


class Noting(RunObserver):
    """Notes number and result of every frame."""

    def __init__(self, seen):
        self.seen = seen

    def frame(self, index, read, result, ms):
        self.seen.append((index, result))


def test_frames_arrive_in_order_and_no_more_than_wanted(slam, recording, tmp_path):
    seen = []
    report = go(recording, tmp_path / "out", max_frames=6, observers=(Noting(seen),))
    assert [i for i, _ in seen] == list(range(6))
    np.testing.assert_allclose([result.timestamp for _, result in seen], 100 + 0.1 * np.arange(6))
    assert report.metrics["frames"] == 6
    for ahead in (0, 1, 4, 20):
        readings = read_ahead(open_sequence(recording), 5, ahead)
        np.testing.assert_allclose([reading.read.frame.timestamp for reading in readings], 100 + 0.1 * np.arange(5))
    assert list(read_ahead(open_sequence(recording), 0)) == []
    with pytest.raises(DatasetError, match="desk has 8 frames and 0 are wanted"):
        go(recording, tmp_path / "none", max_frames=0)


def test_masks_are_written_and_scored(slam, recording, tmp_path):
    truth = np.zeros((HEIGHT, WIDTH), np.uint8)
    truth[:24, :16] = 255  # half of what the stand-in calls dynamic
    (recording / "mask").mkdir()
    cv2.imwrite(str(recording / "mask/1.png"), truth)
    cv2.imwrite(str(recording / "mask/3.png"), np.zeros_like(truth))
    (recording / "mask.txt").write_text("100.104 mask/1.png\n100.304 mask/3.png\n100.404 mask/missing.png\n")
    report = go(recording, tmp_path / "out", save_masks=True)
    names = sorted(path.name for path in (tmp_path / "out/masks").iterdir())
    assert names == [f"{100 + 0.1 * k:.6f}.png" for k in range(8)]
    mask = cv2.imread(str(tmp_path / "out/masks/100.100000.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (HEIGHT, WIDTH)
    assert set(np.unique(mask)) == {0, 255}
    assert np.count_nonzero(mask) == 24 * 32
    assert report.metrics["mask_iou_mean"] == pytest.approx(0.5)
    assert report.metrics["mask_iou_frames"] == 1


def test_unreadable_frames_are_skipped_and_counted(slam, recording, tmp_path, caplog):
    caplog.set_level(logging.INFO, "dudmap.app")
    cut(recording / "depth/3.png")
    (recording / "rgb/4.png").unlink()
    metrics = go(recording, tmp_path / "out").metrics
    assert (metrics["frames"], metrics["unreadable"], metrics["tracked"]) == (8, 2, 6)
    assert "frame 3" in metrics["unreadable_frames"][0]
    said = " ".join(caplog.messages)
    assert "skipped: frame 3" in said
    assert "skipped: frame 4" not in said, "one sentence for a gap"
    assert "frame 5: readable again, 2 skipped" in said


def test_a_lost_track_is_said_once_per_gap(slam, recording, tmp_path, caplog):
    caplog.set_level(logging.INFO, "dudmap.app.pipeline.progress")
    slam.script = {2: "lost", 3: "lost", 6: "lost"}
    go(recording, tmp_path / "out")
    assert [message for message in caplog.messages if message.startswith("frame")] == [
        "frame 2: lost, too few inliers",
        "frame 4: tracked again, 2 lost",
        "frame 6: lost, too few inliers",
        "frame 7: tracked again, 1 lost",
    ]


@pytest.mark.parametrize(
    ("event", "sentence"),
    [
        (KeyboardInterrupt(), "interrupted after 3 frames; the trajectory and the map up to there are in"),
        (DatasetError("the images do not fit"), "the images do not fit; the trajectory and the map up to there are in"),
        (ZeroDivisionError("a bug"), "a bug"),
    ],
)
def test_what_was_computed_is_written_whatever_happens(slam, recording, tmp_path, event, sentence):
    slam.script = {3: event}
    with pytest.raises(type(event), match=sentence):
        go(recording, tmp_path / "out")
    assert len(Trajectory.load(tmp_path / "out/trajectory.txt")) == 3
    assert (tmp_path / "out/map.npz").read_bytes() == b"map"
    assert (tmp_path / "out/mesh.ply").exists()
    metrics = metrics_of(tmp_path / "out")
    assert metrics["complete"] is False
    assert metrics["stopped_by"]
    assert metrics["tracked"] == 3


def test_the_second_pass_is_what_is_written(slam, recording, tmp_path):
    slam.script = {2: "lost", SECOND + 5: "similar"}
    seen = []
    go(recording, tmp_path / "out", passes=2, save_masks=True, observers=(Noting(seen),))
    metrics = metrics_of(tmp_path / "out")
    assert (metrics["frames"], metrics["tracked"], metrics["lost"], metrics["skipped_similar"]) == (8, 8, 0, 1)
    assert [index for index, _ in seen] == [*range(8), *range(8)]
    assert len(list((tmp_path / "out/masks").iterdir())) == 8


def test_a_second_pass_that_is_interrupted_costs_nothing(slam, recording, tmp_path):
    slam.script = {SECOND + 3: KeyboardInterrupt()}
    with pytest.raises(KeyboardInterrupt, match="of the second pass; the trajectory and the map of the first pass are"):
        go(recording, tmp_path / "out", passes=2)
    assert len(Trajectory.load(tmp_path / "out/trajectory.txt")) == 8


@pytest.mark.parametrize("options", [{"passes": 0}, {"passes": 3}, {"passes": 2, "live": True}])
def test_only_one_or_two_passes(slam, recording, tmp_path, options):
    with pytest.raises(ConfigError, match="expected 1, or 2 without live replay"):
        go(recording, tmp_path / "out", **options)


def test_one_file_that_cannot_be_written_does_not_cost_the_others(slam, recording, tmp_path, monkeypatch):
    def full(self, path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(FakeVolume, "save", full)
    with pytest.raises(DudmapError, match=r"is incomplete: .*No space left"):
        go(recording, tmp_path / "out")
    assert (tmp_path / "out/mesh.ply").exists()
    assert metrics_of(tmp_path / "out")["tracked"] == 8


def test_a_run_without_any_pose_is_an_error(slam, recording, tmp_path):
    slam.script = dict.fromkeys(range(8), "lost")
    with pytest.raises(DudmapError, match="none of the 8 frames could be tracked; the first: too few inliers"):
        go(recording, tmp_path / "out")
    assert metrics_of(tmp_path / "out")["lost"] == 8


def test_an_earlier_run_leaves_no_trace_in_the_folder(slam, recording, tmp_path):
    out = tmp_path / "out"
    go(recording, out, save_masks=True)
    (out / "notes.txt").write_text("mine")
    for score in ("evaluation.json", "masks.evaluation.json", "mesh_error.ply", "error.png"):
        (out / score).write_text("of the earlier run")
    go(recording, out, max_frames=2, save_masks=True)
    assert len(list((out / "masks").iterdir())) == 2
    assert (out / "notes.txt").exists()
    assert not list(out.glob("*evaluation.json"))
    assert not list(out.glob("*error.p*"))


def test_where_stamps_are_late_the_poses_of_the_images_are_kept_beside_those_at_the_stamps(slam, recording, tmp_path):
    out = tmp_path / "out"
    calibration = Calibration(open_sequence(recording).camera, depth_late=0.02)
    go(recording, out, calibration=calibration)
    wanted = 0.01 * np.arange(8)
    at_stamps = Trajectory.load(out / "trajectory.txt").Ts_world_camera[:, 0, 3]
    np.testing.assert_allclose(at_stamps, wanted + 0.002, atol=1e-8)  # 1 cm in 0.1 s
    np.testing.assert_allclose(RunContent.load(out).trajectory.Ts_world_camera[:, 0, 3], wanted, atol=1e-8)
    go(recording, out)
    assert not (out / "image_poses.txt").exists()


def test_neither_the_recording_nor_the_masks_given_are_overwritten(slam, recording, tmp_path):
    folder = write_recording(tmp_path / "recording", 3)
    (folder / "masks").mkdir()
    (folder / "masks" / "0.png").write_bytes(b"truth")
    for layout in (replica, corbs):
        other, _ = write(layout, tmp_path / layout.__name__)
        with pytest.raises(DudmapError, match="holds a recording"):
            go(recording, other)
    with pytest.raises(DudmapError, match="holds a recording"):
        go(recording, folder)
    assert (folder / "masks" / "0.png").exists()
    out = tmp_path / "out"
    go(recording, out, save_masks=True)
    with pytest.raises(DudmapError, match="lie in the run folder"):
        go(recording, out, masks=out / "masks")
    assert list((out / "masks").iterdir())


def test_a_folder_that_cannot_be_written_is_found_before_the_work(slam, recording, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DudmapError, match=r"cannot write into the run folder .*file"):
        go(recording, tmp_path / "file")
    with pytest.raises(DudmapError, match="cannot write into the run folder"):
        go(recording, tmp_path / "file" / "below")
    with pytest.raises(DudmapError, match="cannot write into the run folder"):
        go(recording, "/proc/dudmap")


@pytest.mark.parametrize("timed", [True, False])
def test_the_system_knows_whether_times_are_invented(slam, recording, tmp_path, timed):
    sequence = open_sequence(recording)
    sequence.timed = timed
    run(sequence, Config(), tmp_path / "run", progress=False)
    assert slam.timed is timed
    assert metrics_of(tmp_path / "run")["sources"]["times"] == "the recording"
    assert metrics_of(tmp_path / "run")["recording"]["path"] == str(recording.resolve())
