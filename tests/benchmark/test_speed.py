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


def test_a_short_soak_has_a_row_for_each_tenth():
    rows = []
    assert measure_soak(20, (80, 60), 0, rows.append) == rows
    assert [row["frames"] for row in rows] == list(range(2, 21, 2))
    assert grown([*rows[:2], rows[1]]) == []
    worse = {"cpu_ms": 1.2, "memory_mb": 1.2, "error_mm": 50}
    assert len(grown([*rows[:2], {key: rows[1][key] * factor for key, factor in worse.items()}])) == 3
