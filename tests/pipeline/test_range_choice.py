"""The range of a recording: chosen from its readings where nobody gives it, and never taken for a wrong depth unit."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.inspection import inspect
from dudmap.cli import app
from dudmap.config import Config
from dudmap.io.sequences import open_sequence
from dudmap.ranges import size_of
from recordings import HEIGHT, WIDTH, write_recording

INTRINSICS = "fx 60\nfy 60\ncx 31.5\ncy 23.5\ndepth_scale {}\n"


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def recording_from(folder: Path, nearest: float, farthest: float, scale: float = 1000.0) -> Path:
    """A recording whose readings lie evenly between two depths, metres, with the scale in its intrinsics.txt."""
    write_recording(folder, 6, intrinsics=INTRINSICS.format(scale))
    depth = np.tile(np.linspace(nearest, farthest, WIDTH) * scale, (HEIGHT, 1)).astype(np.uint16)
    for path in folder.glob("depth/*.png"):
        cv2.imwrite(str(path), depth)
    return folder


def seen(*depths: float) -> list[np.ndarray]:
    return [np.resize(np.array(depths, np.float32), (8, 8))]


@pytest.mark.parametrize(
    ("depths", "size"),
    [
        ((0.11, 0.16, 0.22), 0.2),  # a wrist camera: voxels of 2 mm
        ((0.31, 0.35, 0.6), 1.0),
        ((0.8, 1.5, 4.0), 1.0),
        ((2.0, 4.9, 9.0), 1.0),
        ((6.3, 9.0, 12.0), 2.0),  # by the 98 % quantile: 600 voxels of 2 cm
        ((6.0, 8.0, 8.0), 1.6),  # by the median: 500 voxels of 1.6 cm
        ((20.0, 60.0, 90.0), 5.0),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.15), 1.0),  # hardly any reading: a lens that is covered
        ((0.0,), 1.0),
    ],
)
def test_the_size_follows_from_the_readings(depths, size):
    assert size_of(seen(*depths)) == size
    assert size_of([]) == 1.0


@pytest.mark.parametrize(("nearest", "farthest"), [(0.11, 0.22), (6.3, 12.5)])
def test_a_range_is_no_wrong_unit(tmp_path, nearest, farthest):
    sequence = open_sequence(recording_from(tmp_path / "desk", nearest, farthest))
    found = inspect(sequence)
    assert not [warning for warning in found.warnings if "depth" in warning]
    assert found.too_near + found.too_far < 0.05
    assert found.voxel_size in (0.002, 0.021)
    room = inspect(sequence, config=Config())
    assert room.too_near + room.too_far > 0.7
    (warning,) = [warning for warning in room.warnings if "readings" in warning]
    assert "--set preprocess.depth_m" in warning
    assert "--depth-unit" not in warning


@pytest.mark.parametrize("source", ["assumed, usual in the format", "the TUM camera, by name", "intrinsics.txt"])
def test_only_an_assumed_unit_is_doubted(tmp_path, source):
    """Units of 0.2 mm, as TUM has them, read as millimetres: 7 to 15 m, or 1.4 to 3 m."""
    sequence = open_sequence(recording_from(tmp_path / "desk", 7.0, 15.0))
    sequence.sources["depth unit"] = source
    warnings = " ".join(inspect(sequence).warnings)
    assert ("4000 or 5000" in warnings) == (source != "intrinsics.txt")
    assert ("--depth-unit" in warnings) == (source != "intrinsics.txt")


def stored(folder: Path) -> Config:
    return Config.load(folder / "config.toml")


def test_a_run_chooses_says_and_obeys(slam, tmp_path):
    near = recording_from(tmp_path / "near", 0.11, 0.22)
    done = call("run", near, "--out", tmp_path / "a")
    assert done.exit_code == 0, done.output
    assert "voxels of 2 mm, depth from 0.04 to 1.2 m, chosen from the depth images" in done.stderr
    assert stored(tmp_path / "a").override(["sensor.self_calibration=true"]) == Config.for_range("near")
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert metrics["readings"] == {"too_near": 0.0, "too_far": 0.0}
    assert metrics["warnings"] == [warning for warning in metrics["warnings"] if "depth unit" not in warning]

    done = call("run", near, "--range", "room", "--out", tmp_path / "b")
    assert "chosen" not in done.stderr
    assert stored(tmp_path / "b").override(["sensor.self_calibration=true"]) == Config()
    metrics = json.loads((tmp_path / "b" / "metrics.json").read_text())
    assert metrics["readings"]["too_near"] == pytest.approx((0.2 - 0.11) / 0.11, abs=0.05)

    call("run", near, "--set", "volume.voxel_size=0.004", "--out", tmp_path / "c")
    assert (stored(tmp_path / "c").volume.voxel_size, stored(tmp_path / "c").preprocess.depth_max) == (0.004, 1.2)

    done = call("run", near, "--range", "close", "--out", tmp_path / "d")
    assert done.exit_code == 1
    assert "found --range close; expected one of near, room, far" in done.stderr


def test_a_range_that_changes_nothing_is_refused(slam, tmp_path):
    Config().save(tmp_path / "all.toml")
    done = call("run", write_recording(tmp_path / "room", 6), "--config", tmp_path / "all.toml", "--range", "near")
    assert done.exit_code == 1
    assert "--range near changes nothing" in done.stderr


def test_a_camera_chooses_from_its_first_frames(slam, tmp_path):
    far = recording_from(tmp_path / "far", 6.3, 12.5)
    done = call("live", f"replay:{far}", "--out", tmp_path / "a")
    assert "chosen from the depth images" in done.stderr
    assert stored(tmp_path / "a").volume.voxel_size == 0.021
    call("live", f"replay:{far}", "--range", "far", "--out", tmp_path / "b")
    assert stored(tmp_path / "b").preprocess.depth_max == 15


def test_a_room_is_not_mentioned(slam, tmp_path):
    room = write_recording(tmp_path / "room", 6)
    done = call("run", room, "--out", tmp_path / "a", "--quiet")
    assert "chosen" not in done.stderr
    assert stored(tmp_path / "a").override(["sensor.self_calibration=true"]) == Config()
    assert "0.2 to 6 m is used, with voxels of 10 mm" in " ".join(call("info", room).stdout.split())
