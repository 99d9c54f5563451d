"""dudmap benchmark speed: the table, its failures, and a map that outgrows its table."""

import numpy as np
import pytest

from dudmap.errors import DudmapError
from dudmap.lab.benchmark import speed
from dudmap.lab.benchmark.soak import grown, measure_soak
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA


def test_the_table_says_what_is_reached():
    figures = [
        speed.SpeedFigure("frame", "ms", 33, 20.44),
        speed.SpeedFigure("view", "ms", 40, 41.0, "slow"),
        speed.SpeedFigure("walk", "x", 1.1, None),
    ]
    lines = speed.markdown(figures).splitlines()
    assert lines[2] == "| frame | <= 33 ms | 20.4 ms | yes |  |"
    assert lines[3] == "| view | <= 40 ms | 41 ms | NO | slow |"
    assert lines[4] == "| walk | <= 1.1 x | none | NO |  |"


def test_programs_are_timed_and_a_failing_one_is_a_sentence():
    assert 0 < speed.program_seconds(["-c", "pass"], 1) < 5
    with pytest.raises(DudmapError, match="failed: nothing works"):
        speed.program_seconds(["-c", "import sys; sys.exit('nothing works')"], 1)


def test_the_first_frame_may_need_more_blocks_than_the_table_was_made_for():
    from dudmap.config import SensorConfig, VolumeConfig
    from dudmap.core.map.volume import TsdfVolume

    volume = TsdfVolume(DEFAULT_CAMERA, VolumeConfig(voxel_size=0.005), SensorConfig(), 4.0)
    volume.look_at(np.eye(4))
    cells = np.arange(70_000, dtype=np.int32)
    assert np.array_equal(volume.window.entries_of(cells, volume.blocks), cells)
    again = volume.window.entries_of(cells[::-1].copy(), volume.blocks)
    assert np.array_equal(again, cells[::-1]), "found again, not made again"


def test_a_figure_without_a_target_is_only_shown():
    lines = speed.markdown([speed.SpeedFigure("mesh again", "ms", None, 12.3, "40 chunks")]).splitlines()
    assert lines[2] == "| mesh again |  | 12.3 ms |  | 40 chunks |"


STAND_IN = """
import json, sys
from pathlib import Path
import numpy as np
folder, voxel, depth_max = Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
depth, color = np.load(folder / "depth.npy"), np.load(folder / "color.npy")
camera = json.loads((folder / "camera.json").read_text())
assert (depth.dtype, color.dtype, voxel, depth_max) == ("uint16", "uint8", 0.01, 6.0)
assert depth.shape == (12, camera["height"], camera["width"]) and color.shape == depth.shape + (3,)
print("a warning first")
poses = np.tile(np.eye(4), (len(depth), 1, 1))
poses[:, :3, 3] = np.random.default_rng(0).normal(size=(len(depth), 3))
print(json.dumps({"version": "0", "ms": [1e4] * len(depth), "poses": poses.tolist()}))
"""


def test_both_systems_get_the_same_frames_in_turn(monkeypatch):
    """Open3D replaced by a program that checks what it is given, takes ten seconds a frame and jumps about."""
    import sys
    from pathlib import Path

    from dudmap.lab.benchmark.open3d_comparison import compare_with_open3d
    from dudmap.lab.benchmark.suites import Entry

    monkeypatch.setattr(Path, "read_text", _instead_of(Path.read_text, "open3d_slam.py", STAND_IN))
    entry = Entry("room-static", parameters={"movers": (), "frames": 12, "camera": (160, 120)})
    result = compare_with_open3d(Path(sys.executable), entry.open(), 50, rounds=1)
    assert result.frames == 12
    assert result.theirs_ms == 1e4
    assert 0 < result.ours_ms < 1e4
    assert 0 < result.ours_ate < result.theirs_ate


def _instead_of(read_text, name, text):
    return lambda path, *args, **options: text if path.name == name else read_text(path, *args, **options)


def test_a_python_without_open3d_is_refused(tmp_path):
    from dudmap.lab.benchmark.open3d_comparison import compare_with_open3d
    from dudmap.lab.benchmark.suites import Entry

    room = Entry("room-static", parameters={"movers": (), "frames": 2, "camera": (160, 120)}).open()
    with pytest.raises(DudmapError, match="cannot run"):
        compare_with_open3d(tmp_path / "nothing", room, 2, rounds=1)
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho 'No module named open3d' >&2\nexit 1\n")
    program.chmod(0o755)
    with pytest.raises(DudmapError, match="failed: No module named open3d"):
        compare_with_open3d(program, room, 2, rounds=1)


def test_a_short_soak_has_a_row_for_each_tenth():
    rows = []
    assert measure_soak(20, (80, 60), 0, rows.append) == rows
    assert [row["frames"] for row in rows] == list(range(2, 21, 2))
    assert grown([*rows[:2], rows[1]]) == []
    worse = {"cpu_ms": 1.2, "memory_mb": 1.2, "error_mm": 50}
    assert len(grown([*rows[:2], {key: rows[1][key] * factor for key, factor in worse.items()}])) == 3
