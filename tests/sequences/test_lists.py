"""Lists as other programs write them: units of time, encodings, headers, names with blanks, damaged ground truth."""

import codecs
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.pipeline.inspection import inspect
from dudmap.cli import app
from dudmap.core.geometry.times import time_unit
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError
from dudmap.io.sequences import open_sequence
from layout_images import millimetres, pose, tum_line, write_color, write_depth
from layouts import tum, write

START = 1_700_000_000.25
PER_SECOND = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
FIRST = {"since 1970": START, "since the start": 0.0, "since the boot": 5400.0}


def stamp(k, unit, first):
    """Time of frame k at 30 Hz, as text in a unit."""
    return f"{first + k / 30:.6f}" if unit == "seconds" else f"{round((first + k / 30) * PER_SECOND[unit])}"


def rewrite_times(folder, unit, first):
    """Give the lists of ``layouts.tum`` other times, and the colours 4 ms before their depths."""
    lines = {"rgb": "", "depth": "", "groundtruth": ""}
    for k in range(3):
        for kind in ("rgb", "depth"):
            when = stamp(k, unit, first + (0.004 if kind == "depth" else 0))
            lines[kind] += f"{when} {kind}/{100 + 0.1 * k:.6f}.png\n"
        lines["groundtruth"] += tum_line(stamp(k, unit, first), pose(k))
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text(text)


@pytest.mark.parametrize("first", FIRST)
@pytest.mark.parametrize("unit", PER_SECOND)
def test_lists_and_truth_in_any_unit(tmp_path, unit, first):
    folder, _ = write(tum, tmp_path)
    rewrite_times(folder, unit, FIRST[first])
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps - FIRST[first], 0.004 + np.arange(3) / 30, atol=1.1e-3)
    np.testing.assert_allclose(sequence.color_timestamps - FIRST[first], np.arange(3) / 30, atol=1.1e-3)
    np.testing.assert_allclose(sequence.ground_truth.timestamps - FIRST[first], np.arange(3) / 30, atol=1.1e-3)
    assert (unit in sequence.sources["times"]) == (unit != "seconds")
    assert any(f"taken as {unit}" in said for said in inspect(sequence).warnings) == (unit != "seconds")


@pytest.mark.parametrize("unit", ["milliseconds", "microseconds", "nanoseconds"])
def test_associations_in_any_unit(tmp_path, unit):
    folder, _ = write(tum, tmp_path)
    names = [f"{100 + 0.1 * k:.6f}.png" for k in range(3)]
    rows = [f"{stamp(k, unit, 0)} rgb/{name} {stamp(k, unit, 0)} depth/{name}" for k, name in enumerate(names)]
    (folder / "associations.txt").write_text("\n".join(rows))
    np.testing.assert_allclose(open_sequence(folder).timestamps, np.arange(3) / 30, atol=1e-3)


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (np.arange(40.0), "seconds"),  # numbers of frames
        (np.arange(0, 400, 10.0), "seconds"),  # every tenth frame
        (np.arange(100) / 300, "seconds"),  # motion capture
        (1.3e9 + np.arange(20) * 60.0, "seconds"),  # an image a minute
        ([1305031102.175304], "seconds"),
        ([1305031102175], "milliseconds"),
        ([1305031102175304000], "nanoseconds"),
        ([0, 33333333, 66666666, 900000000], "nanoseconds"),
        ([0, 33333, 66666, 99999], "microseconds"),
        ([0, 33, 67, 100, 133], "milliseconds"),
        (1.7e18 + np.arange(5) * 2e9, "nanoseconds"),  # an image every two seconds
        (1.5e12 + np.arange(5) * 33333333, "nanoseconds"),  # 25 minutes after the boot, no milliseconds of 2017
        ([], "seconds"),
        ([7.0, 7.0], "seconds"),
    ],
)
def test_units_of_stamps(stamps, unit):
    assert time_unit(stamps).name == unit
    assert time_unit(list(reversed(stamps))).name == unit


def test_evaluate_takes_files_in_two_units(tmp_path):
    poses = [(START + k / 30, pose(k)) for k in range(3)]
    Trajectory.from_poses(poses).save(tmp_path / "estimate.txt")
    lines = [tum_line(round(t * 1e9), T) for t, T in poses]
    (tmp_path / "truth.txt").write_text("time x y z qx qy qz qw\n" + "".join(lines))
    call = ["evaluate", "trajectory", str(tmp_path / "estimate.txt"), "--reference", str(tmp_path / "truth.txt")]
    result = CliRunner().invoke(app, [*call, "--json", "--align", "none"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["ate_rmse_m"] < 1e-5
    assert "the times of truth.txt are taken as nanoseconds" in result.stderr


# -- encodings and names -----------------------------------------------------------------------------------------------

ENCODINGS = {
    "UTF-8 with a mark": lambda text: codecs.BOM_UTF8 + text.encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "big-endian UTF-16": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_of_lists_and_json(tmp_path, encoding):
    folder, expected = write(tum, tmp_path)
    (folder / "intrinsics.txt").unlink()
    values = dict(zip(("fx", "fy", "cx", "cy"), expected.intrinsics, strict=True))
    (folder / "camera.json").write_text(json.dumps(values))
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt", "camera.json"):
        file = folder / name
        file.write_bytes(ENCODINGS[encoding](file.read_text().replace("\n", "\r\n")))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps, expected.stamps)
    assert (sequence.camera.fx, sequence.camera.cy) == (60, 23)
    assert len(sequence.ground_truth) == 3


@pytest.mark.parametrize("quote", ["", '"', "'"])
@pytest.mark.parametrize("form", ["two lists", "associations"])
def test_names_with_blanks(tmp_path, quote, form):
    lines = {"rgb": "timestamp filename\n", "depth": "", "associations": ""}
    for k in range(3):
        names = {kind: f"{kind} 1/my  image {k} 7.png" for kind in ("rgb", "depth")}
        write_color(tmp_path / names["rgb"], k)
        write_depth(tmp_path / names["depth"], k)
        rows = {kind: f"{k / 30:.4f} {quote}{name}{quote}" for kind, name in names.items()}
        for kind, row in rows.items():
            lines[kind] += row + "\n"
        lines["associations"] += f"{rows['depth']}, {rows['rgb']}\n"
    for name in ("associations",) if form == "associations" else ("rgb", "depth"):
        (tmp_path / f"{name}.txt").write_text(lines[name])
    sequence = open_sequence(tmp_path, "60,61,31,23,64,48,1000")
    for k in range(3):
        np.testing.assert_allclose(sequence[k].depth, millimetres(k) / 1000, atol=1e-6)
        assert sequence[k].color[0, 0, 0] == 60 + 10 * k


def test_poses_behind_the_files_of_a_row(tmp_path):
    folder, _ = write(tum, tmp_path)
    names = [f"{100 + 0.1 * k:.6f}" for k in range(3)]
    rows = [tum_line(f"{t} rgb/{t}.png {t} depth/{t}.png {t}", pose(0)) for t in names]
    (folder / "associations.txt").write_text("".join(rows))
    assert len(open_sequence(folder)[2].depth)


# -- ground truth that is damaged --------------------------------------------------------------------------------------

SPOILT = {
    "not a number": lambda lines: [lines[0], lines[1].replace(lines[1].split()[2], "nan"), lines[2]],
    "a zero quaternion": lambda lines: [lines[0], lines[1].split()[0] + " 0 0 0 0 0 0 0", lines[2]],
    "cut off": lambda lines: [lines[0], lines[1][:20], lines[2]],
    "twice": lambda lines: [lines[0], lines[0], lines[2]],
}


@pytest.mark.parametrize("defect", SPOILT)
def test_rows_of_the_truth_that_are_none(tmp_path, defect):
    folder, _ = write(tum, tmp_path)
    file = folder / "groundtruth.txt"
    lines = file.read_text().splitlines()[1:]
    file.write_text("\n".join(["time x y z qx qy qz qw", *SPOILT[defect](lines)]))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.ground_truth.timestamps, [100, 100.2])
    np.testing.assert_allclose(sequence.ground_truth.Ts_world_camera[1], pose(2), atol=1e-6)
    (said,) = (text for text in inspect(sequence).warnings if "left out" in text)
    assert said.startswith("ground truth: 1 of 3 rows are left out; the first: ")
    assert "line 3" in said
    with pytest.raises(DatasetError, match=r"groundtruth\.txt"):
        Trajectory.load(file)


@pytest.mark.parametrize("content", [b"", b"no poses here\nnone at all\n", b"\xff\xfe\x00", b"1 2 3\n"])
def test_a_recording_opens_without_its_truth(tmp_path, content):
    folder, _ = write(tum, tmp_path)
    (folder / "groundtruth.txt").write_bytes(content)
    sequence = open_sequence(folder)
    assert sequence.ground_truth is None
    (said,) = (text for text in inspect(sequence).warnings if "ground truth" in text)
    assert said.startswith("the ground truth is not used: ")
    assert "groundtruth.txt" in said
    assert sequence[0].depth.any()


def test_lists_of_images_are_needed(tmp_path):
    folder, _ = write(tum, tmp_path)
    (folder / "depth.txt").write_text("100.0 depth/100.000000.png\nnan depth/100.100000.png\n")
    with pytest.raises(DatasetError, match=r"depth\.txt, line 2: the timestamp 'nan' is not a finite number"):
        open_sequence(folder)
