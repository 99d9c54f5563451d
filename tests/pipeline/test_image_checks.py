"""Wrong input that still runs is said: of a spoilt real excerpt, and of spoilt synthetic recordings."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.calibration import calibrate_start
from dudmap.app.pipeline.image_checks import color_magnification, image_warnings
from dudmap.app.pipeline.inspection import inspect
from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.io.sequences import open_sequence
from dudmap.lab import synthetic
from dudmap.lab.synthetic.faults import SensorFaults
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA
from spoilt import LARGE, RIGHT, SPOILT, SpoiltSequence

EXCERPT = Path(__file__).parents[1] / "fixtures" / "freiburg1_xyz"
SAID = {
    RIGHT: [],
    LARGE: ["give --depth-unit 0.0002, which is 5000 per metre"],
    "depth five times too small": ["25000 units per metre"],
    "colour mirrored left-right": ["seems to be mirrored left-right against the other"],
    "colour upside down": ["seems to be upside down"],
    "colour rotated by 180 degrees": ["seems to be rotated by 180 degrees against the other"],
    "colour black": ["tracked by distances alone"],
    "depth a flat wall of noise": ["show the same plane at 2 m, with 4.0 mm of noise"],
    "the same, colour black": ["which show one plane and not how the camera moves along it"],
}


@pytest.mark.parametrize("name", SPOILT)
def test_each_kind_of_wrong_input_has_one_warning(name):
    warnings = inspect(SpoiltSequence(open_sequence(EXCERPT), name, 12)).warnings
    assert len(warnings) == len(SAID[name])
    for warning, part in zip(warnings, SAID[name], strict=True):
        assert part in warning


def test_depth_turned_instead_of_colour():
    sequence = open_sequence(EXCERPT)
    frames = [sequence[index] for index in range(len(sequence))]
    assert image_warnings(frames) == []
    (warning,) = image_warnings([replace(f, depth=np.ascontiguousarray(f.depth[:, ::-1])) for f in frames])
    assert "mirrored left-right" in warning


def wall(number, *, moving, color):
    """A wall at 2 m, seen with changing exposure by a camera at rest or one that comes 1 mm nearer per frame."""
    rng = np.random.default_rng(number)
    depth = rng.normal(2.0 - 0.001 * number * moving, 0.004, (60, 80)).astype(np.float32)
    texture = np.random.default_rng(color).integers(0, 200, (60, 80, 3)) * (1 - 0.05 * number)
    return Frame(0.1 * number, depth, texture.astype(np.uint8))


def test_a_wall_before_a_camera_that_rests_or_moves_is_no_fault():
    assert image_warnings([wall(number, moving=False, color=7) for number in range(8)]) == []
    assert image_warnings([wall(number, moving=True, color=number) for number in range(8)]) == []
    (warning,) = image_warnings([wall(number, moving=False, color=number) for number in range(8)])
    assert "the same plane at 2 m" in warning


def near_wall(seed):
    """Frames of a near wall with a step in the depth and a picture on it, which have no edge in common, at rest."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:120, :160]

    def blob():
        cx, cy, rx, ry = rng.uniform(0, 160), rng.uniform(0, 120), *rng.uniform(2, 30, 2)
        return ((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2 < 1

    step, picture = 0.6 * (1 + 0.3 * (blob() | blob())), 150 + 60.0 * blob() - 70.0 * blob()
    for number in range(4):
        depth = (step + rng.normal(0, 0.001, step.shape)).astype(np.float32)
        gray = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
        yield Frame(number / 30, depth, np.repeat(gray[..., None], 3, axis=2))


def test_a_near_wall_without_common_edges_is_not_called_turned():
    said = [text for seed in range(60) for text in image_warnings(list(near_wall(seed)))]
    assert said == []


def test_frames_that_show_the_same_count_as_one():
    sequence = open_sequence(EXCERPT)
    frame = replace(sequence[0], color=np.ascontiguousarray(sequence[0].color[:, ::-1]))
    (warning,) = image_warnings([frame] * 12)
    assert image_warnings([frame] * 4) == [warning]


@pytest.mark.slow
@pytest.mark.parametrize("name", SPOILT)
def test_wrong_input_of_a_synthetic_recording_is_said(name):
    scene = "room" if name == LARGE else "desk"  # too small a scale shows at a desk, too large a one in a room
    recording = synthetic.sequence(scene, frames=6, camera=DEFAULT_CAMERA.resized(80, 60))
    assert bool(inspect(SpoiltSequence(recording, name, 6)).warnings) == (name != RIGHT)


def test_warnings_are_in_the_metrics_and_the_report(tmp_path):
    done = CliRunner().invoke(
        app, ["run", str(EXCERPT), "--out", str(tmp_path / "run"), "--max-frames", "3", "--depth-unit", "0.005",
              "--calibration", "given"],
    )  # fmt: skip
    assert done.exit_code in (0, 3), done.output  # depths of 25 m may leave no mesh
    (warning,) = json.loads((tmp_path / "run" / "metrics.json").read_text())["warnings"]
    assert "the depth scale looks wrong" in warning
    assert f"warning: {warning}" in done.stderr
    assert f"warning: {warning}" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize(("ratio", "seed"), [(1.6, 1), (0.65, 2)])
def test_colours_that_are_not_registered_are_found_and_calibrated_from_there(ratio, seed, caplog):
    faults = SensorFaults(color_focal_ratio=ratio, color_translation=(0.015, 0.0, 0.0))
    recorded = synthetic.sequence(movers=(), frames=24, camera=DEFAULT_CAMERA.scaled(1), faults=faults, seed=seed)
    assert color_magnification(recorded) == pytest.approx(ratio, rel=0.1)
    start = calibrate_start(recorded, Config(), 24, lambda done, total: None)
    assert start.camera.fx / recorded.camera.fx == color_magnification(recorded)
    assert start.estimated == ("log_focal",)
    assert "the edges of both images agree where its focal length is" in caplog.messages[0]


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_colours_that_a_calibration_finds_by_itself_are_not_called_unregistered(ratio):
    faults = SensorFaults(color_focal_ratio=ratio, color_translation=(0.03, 0.0, 0.0))
    recorded = synthetic.sequence(movers=(), frames=24, camera=DEFAULT_CAMERA.scaled(1), faults=faults, seed=3)
    assert color_magnification(recorded) is None


def test_colours_of_another_size_are_calibrated_from_the_view_of_the_depth(tmp_path):
    faults = SensorFaults(color_focal_ratio=1.5, color_translation=(0.015, 0.0, 0.0))
    recorded = synthetic.sequence(movers=(), frames=16, camera=DEFAULT_CAMERA.scaled(1), faults=faults, seed=4)
    for kind in ("color", "depth"):
        (tmp_path / kind).mkdir()
    for number in range(len(recorded)):
        frame = recorded[number]
        wide = cv2.resize(frame.color, (480, 360))[45:315, :, ::-1]  # 16:9
        cv2.imwrite(str(tmp_path / f"color/{number}.png"), wide)
        cv2.imwrite(str(tmp_path / f"depth/{number}.png"), (1000 * frame.depth).astype(np.uint16))
    folder = open_sequence(tmp_path, camera=recorded.camera)
    assert folder.calibration.camera.shape == (270, 480)
    assert folder.sources["colour camera"].startswith("the depth camera, assumed")
    start = calibrate_start(folder, Config(), 16, lambda done, total: None)
    assert start.camera.fx / (1.5 * 1.5 * recorded.camera.fx) == pytest.approx(1, rel=0.1)
