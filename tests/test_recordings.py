"""Accuracy on the recordings in the folder that DUDMAP_DATA names, which are too large for the repository.

    DUDMAP_DATA=FOLDER pytest -m data tests/test_recordings.py

Every sequence folder in it is run in full by the default configuration and by the system of the thesis.
"""

import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dudmap import resume_system, save_system
from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.slam import Slam
from dudmap.evaluation.trajectory import ate
from dudmap.io.sequences import is_recording, open_sequence
from state_differences import differences

DATA = os.environ.get("DUDMAP_DATA", "")
FOLDERS = [path for path in sorted(Path(DATA).iterdir()) if path.is_dir() and is_recording(path)] if DATA else []

ATE_RMSE_M = {
    "fr1_xyz_static": 0.0079,
    "fr1_xyz_confusao": 0.0087,
    "fr1_rpy_static": 0.0246,
    "pan_confusao": 0.0032,
    "ist_confusao": 0.0039,
}
"""ATE RMSE of the default configuration, metres: docs/benchmarks.md, section Development recordings."""
CUTS = [((0, 49), (67, 107)), ((0, 81), (153, 190))]
"""Frames of fr1_xyz_static, in pieces joined without a gap: the camera jumps by 11 and 16 cm."""
CUT_ATE_M = 0.025
"""Largest ATE RMSE of such a recording by distances alone, metres; that of the whole one is 0.017."""
MARGIN = 1.5
"""Factor on these errors, for processors that round differently."""
TRACKED_BY_THESIS = 0.95
"""Smallest share of tracked frames of the system of the thesis."""

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not DATA, reason="DUDMAP_DATA names no folder of recordings"),
]


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda path: path.name)
def default_run(request, tmp_path_factory):
    """Run folder and metrics of a whole recording with the default configuration."""
    out = tmp_path_factory.mktemp(request.param.name)
    report = run(open_sequence(request.param), Config(), out, progress=False, save_map=False)
    return out, report.metrics


def test_there_are_recordings():
    assert FOLDERS, f"DUDMAP_DATA={DATA} holds no recording"


def test_the_default_tracks_every_frame(default_run):
    _, metrics = default_run
    assert metrics["lost"] == 0, metrics["lost_frames"]
    assert metrics["tracked"] == metrics["frames"]
    assert metrics["maps"] == 1


def test_the_default_is_as_accurate_as_documented(default_run):
    _, metrics = default_run
    if metrics["sequence"] not in ATE_RMSE_M:
        pytest.skip(f"no error of {metrics['sequence']} is documented")
    assert metrics["ate_rmse_m"] <= MARGIN * ATE_RMSE_M[metrics["sequence"]]


def test_evo_finds_the_same_error(default_run, tmp_path):
    """evo runs as a separate program on the same two files.

    It has no least-squares alignment onto a camera that does not move: there the first poses are aligned.
    """
    out, metrics = default_run
    if "ate_rmse_m" not in metrics:
        pytest.skip("there is no ground truth")
    reference, ours = Trajectory.load(out / "groundtruth.txt"), metrics["ate_rmse_m"]
    fixed = np.ptp(reference.Ts_world_camera[:, :3, 3], axis=0).max() < 1e-3
    if fixed:
        ours = ate(Trajectory.load(out / "trajectory.txt"), reference, align="origin").rmse
    results = tmp_path / "ate.zip"
    done = subprocess.run(
        [
            Path(sys.executable).with_name("evo_ape"), "tum", out / "groundtruth.txt", out / "trajectory.txt",
            "--align_origin" if fixed else "--align", "--t_max_diff", "0.02",
            "--save_results", results, "--no_warnings",
        ],
        capture_output=True, text=True, check=False, env=os.environ | {"HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(results) as archive, archive.open("error_array.npy") as file:
        errors = np.load(file)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(ours, rel=0.01)


@pytest.mark.parametrize("pieces", CUTS, ids=str)
def test_a_camera_that_jumps_is_not_silently_wrong_without_colour(pieces):
    """By distances alone the frame after each jump converges, and passes for tracked, 0.2 m beside the truth."""
    folder = Path(DATA) / "fr1_xyz_static"
    if not folder.is_dir():
        pytest.skip("fr1_xyz_static is not there")
    sequence = open_sequence(folder)
    slam = Slam(sequence.camera, Config().override(["tracker.color_weight=0"]))
    truth = sequence.ground_truth
    assert truth is not None
    stamps, poses = [], []
    for number, index in enumerate(index for piece in pieces for index in range(*piece)):
        slam.process(replace(sequence[index], timestamp=number / 30))
        stamps.append(number / 30)
        poses.append(truth.Ts_world_camera[np.argmin(np.abs(truth.timestamps - sequence.timestamps[index]))])
    error = ate(slam.trajectory, Trajectory(np.array(stamps), np.array(poses)))
    assert error.rmse < CUT_ATE_M


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
def test_the_system_of_the_thesis_tracks(folder, tmp_path):
    config = Config.from_tree({"system": "thesis"})
    metrics = run(open_sequence(folder), config, tmp_path, progress=False, save_map=False).metrics
    assert metrics["tracked"] >= TRACKED_BY_THESIS * metrics["frames"], metrics["lost_frames"][:3]


def test_a_system_that_is_stored_while_it_calibrates_goes_on_the_same(tmp_path):
    """Colours are late by what is given; saved while a better calibration is estimated, and once it is in use."""
    sequence = open_sequence(Path(DATA) / "fr1_xyz_confusao")
    given = replace(Calibration.registered(sequence.camera), delay=0.015)
    slam, again = Slam(sequence.camera, Config(), calibration=given), None
    for index in range(220):
        result = slam.process(sequence[index])
        if again is not None:
            other = again.process(sequence[index])
            np.testing.assert_array_equal(result.T_world_camera, other.T_world_camera)
            np.testing.assert_array_equal(result.dynamic_mask, other.dynamic_mask)
        if index in (130, 200):
            if again is not None:
                assert differences(slam, again) == []
            save_system(slam, tmp_path / "state.db")
            again = resume_system(tmp_path / "state.db")
            assert differences(slam, again) == []
    assert again.calibration.estimated
    assert again.calibration.delay > 0
    assert differences(slam, again) == []
