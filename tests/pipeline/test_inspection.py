"""What ``dudmap info`` and ``dudmap run`` say of a recording: what it holds, and what looks wrong in it."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.inspection import inspect, repeats
from dudmap.cli import app
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.io.sequences import open_sequence
from recordings import HEIGHT, WIDTH, color_image, cut, write_recording


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "desk", 6)


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_what_is_found(recording):
    (recording / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 1\n100.2 1 2 3 0 0 0 1\n")
    found = inspect(open_sequence(recording))
    assert (found.name, found.format, found.frames) == ("desk", "TUM RGB-D", 6)
    assert (found.duration, found.rate, found.color_rate) == pytest.approx((0.5, 10, 10))
    assert found.camera["width"] == WIDTH
    assert found.color_camera == found.camera
    assert found.sources["intrinsics"].endswith("intrinsics.txt")
    depths = np.concatenate([frame.depth.ravel() for frame in map(open_sequence(recording).__getitem__, range(6))])
    assert found.median_depth == pytest.approx(np.median(depths[depths > 0]))
    assert found.valid_depth == pytest.approx(np.mean(depths > 0))
    assert found.ground_truth == 2
    assert found.gaps == []
    assert found.warnings == []


def test_rates_are_those_of_distinct_images(recording):
    """Frames at 10 Hz, of which every second one repeats the depth, and the last both images."""
    depths, colors = (sorted(recording.glob(kind)) for kind in ("depth/*.png", "rgb/*.png"))
    for old, new in ((0, 1), (2, 3), (4, 5)):
        depths[new].write_bytes(depths[old].read_bytes())
    colors[5].write_bytes(colors[4].read_bytes())
    sequence = open_sequence(recording)
    found = inspect(sequence)
    assert found.distinct_rate("depth") is None  # not looked at
    found.repeats = repeats(sequence)
    assert found.repeats == pytest.approx({"frame": 1 / 5, "depth": 2 / 5, "color": 0})
    assert found.distinct_rate("depth") == pytest.approx(10 * (1 - 3 / 5))
    assert found.distinct_rate("color") == pytest.approx(10 * (1 - 1 / 5))
    said = " ".join(call("info", recording).stdout.split())
    assert "about 4 Hz depth, 8 Hz colour; 20% of the frames repeat both images, 40% of the frames repeat depth" in said
    assert "times from the recording" in said


def warnings(sequence):
    return "; ".join(inspect(sequence).warnings)


@pytest.mark.parametrize(("scale", "proposal"), [(5e6, "1000 or 4000 or 5000"), (50, "1000 or")])
def test_a_wrong_depth_scale(recording, scale, proposal):
    for path in recording.glob("depth/*.png"):
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 4000, np.uint16))
    said = warnings(open_sequence(recording, f"60,60,31.5,23.5,{WIDTH},{HEIGHT},{scale}"))
    assert "the depth scale looks wrong" in said
    assert proposal in said
    assert "give --depth-unit 0.001, which is 1000 per metre" in said


@pytest.mark.parametrize(
    ("camera", "sentence"),
    [
        ("2000,2000,31.5,23.5", "field of view of 2 x 1 degrees"),
        ("10,10,31.5,23.5", "field of view of 145 x 135 degrees"),
        ("60,60,310,23.5", "principal point cx of 310 in an image of 64 pixels"),
        ("60,60,31.5,2", "principal point cy of 2 in an image of 48 pixels"),
        ("60,80,31.5,23.5", "focal lengths of 60 and 80"),
    ],
)
def test_implausible_intrinsics(recording, camera, sentence):
    said = warnings(open_sequence(recording, camera))
    assert "the intrinsics of the depth camera look wrong" in said
    assert sentence in said


def test_implausible_intrinsics_of_the_colour_camera(recording):
    sequence = open_sequence(recording)
    sequence.calibration = Calibration(replace(sequence.camera, cx=300.0))
    assert "the intrinsics of the colour camera look wrong: a principal point cx of 300" in warnings(sequence)


def test_times_that_are_no_seconds(tmp_path):
    recording = write_recording(tmp_path / "desk", 6, rgb_shift=0.0)
    for name in ("rgb", "depth"):
        rows = [line.split() for line in (recording / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        text = "".join(f"{50 * float(stamp):.1f} {file}\n" for stamp, file in rows)
        (recording / f"{name}.txt").write_text(text)
    assert "the times look wrong: 5 s from frame to frame" in warnings(open_sequence(recording))


def test_colour_and_depth_that_do_not_belong_together(recording):
    pairs = [f"{100 + 0.1 * (5 - k)} rgb/{5 - k}.png {100 + 0.1 * k} depth/{k}.png\n" for k in range(6)]
    (recording / "associations.txt").write_text("".join(pairs))
    said = warnings(open_sequence(recording))
    assert "colour and depth are 300 ms apart in most frames" in said
    assert "the times of the lists are mixed up" in said


def test_gaps_unreadable_frames_sparse_depth_and_a_truth_of_another_time(tmp_path):
    folder = write_recording(tmp_path / "gaps", 12)
    for name in ("rgb", "depth"):
        lines = (folder / f"{name}.txt").read_text().splitlines()
        (folder / f"{name}.txt").write_text(
            "\n".join(line for k, line in enumerate(lines) if k not in (4, 5, 6)) + "\n"
        )
    cut(folder / "depth/1.png")
    sparse = np.zeros((HEIGHT, WIDTH), np.uint16)
    sparse[:4] = 5000
    for k in (0, *range(2, 12)):
        cv2.imwrite(str(folder / f"depth/{k}.png"), sparse)
    (folder / "groundtruth.txt").write_text("900 0 0 0 0 0 0 1\n901 1 2 3 0 0 0 1\n")
    found = inspect(open_sequence(folder))
    assert len(found.gaps) == 1
    assert found.gaps[0][1] == pytest.approx(0.4)
    assert len(found.unreadable) == 1
    said = "; ".join(found.warnings)
    assert "sampled frames cannot be read; the first: frame 1" in said
    assert "only 8% of the pixels have a depth reading" in said
    assert "the ground truth (900.000 to 901.000 s) is of another time than the images" in said


def test_a_sequence_that_is_no_file(recording):
    class Live:
        name = "live"
        camera = Camera(60, 60, 31.5, 23.5, WIDTH, HEIGHT)
        calibration = None
        timestamps = np.array([1.0])
        ground_truth = Trajectory.from_poses([(1.0, np.eye(4))])

        def __len__(self):
            return 1

        def __getitem__(self, index):
            return open_sequence(recording)[index]

    found = inspect(Live())
    assert (found.format, found.rate, found.color_rate) == ("Live", None, None)


def test_the_command(recording, tmp_path):
    result = call("info", recording, "--sheet", tmp_path / "sheet.png")
    assert result.exit_code == 0
    camera = "assumed to be registered to depth; not tested"
    for text in ("TUM RGB-D", "6 in 0.50 s, 10 Hz depth, 10 Hz colour", camera, "5000 units per metre"):
        assert text in result.stdout
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape[1] > sheet.shape[0] > 200
    assert (np.abs(sheet.astype(int) - color_image()[0, 0, ::-1]).sum(axis=-1) < 12).any()  # colours are not swapped
    tree = json.loads(call("info", recording, "--json").stdout)
    assert tree["frames"] == 6
    assert tree["camera"]["fx"] == open_sequence(recording).camera.fx
    assert tree["warnings"] == []


def test_the_command_on_a_recording_with_faults(recording):
    result = call("info", recording, "--camera", "60,80,31.5,23.5")
    assert result.exit_code == 0
    assert "warning: the intrinsics of the depth camera look wrong: focal lengths of 60 and 80" in result.stdout
    (recording / "intrinsics.txt").unlink()
    result = call("info", recording)
    assert result.exit_code == 1
    assert "give --camera fx,fy,cx,cy[,w,h[,depth_scale]]" in result.stderr
