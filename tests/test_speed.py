"""dudmap benchmark speed: the table, its failures, the passage of new space, and a map that outgrows its table."""

import numpy as np
import pytest

from dudmap.benchmark import speed
from dudmap.benchmark.passage import passage
from dudmap.errors import DudmapError
from dudmap.synthetic.recording import DEFAULT_CAMERA


def test_the_table_says_what_is_reached():
    figures = [
        speed.Figure("frame", "ms", 33, 20.44),
        speed.Figure("view", "ms", 40, 41.0, "slow"),
        speed.Figure("walk", "x", 1.1, None),
    ]
    lines = speed.markdown(figures).splitlines()
    assert lines[2] == "| frame | <= 33 ms | 20.4 ms | yes |  |"
    assert lines[3] == "| view | <= 40 ms | 41 ms | NO | slow |"
    assert lines[4] == "| walk | <= 1.1 x | nothing | NO |  |"


def test_programs_are_timed_and_a_failing_one_is_a_sentence():
    assert 0 < speed._of_program(["-c", "pass"], 1) < 5
    with pytest.raises(DudmapError, match="failed: nothing works"):
        speed._of_program(["-c", "import sys; sys.exit('nothing works')"], 1)


def test_the_passage_is_new_space_all_along():
    walk = passage(600)
    positions = walk.ground_truth.Ts_world_camera[:, :3, 3]
    assert positions[-1, 1] - positions[0, 1] == pytest.approx(0.3 * 599 / 30, abs=1e-6)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() < 0.02
    walk.camera = DEFAULT_CAMERA.resized(80, 60)
    for index in (0, 300, 599):
        depth = walk.exact_depth(index)
        assert (depth > 0.3).mean() > 0.99
        assert np.median(depth) < 4.0
        assert depth.std() > 0.2, "there must be something to see"


def test_the_first_frame_may_need_more_blocks_than_the_table_was_made_for():
    from dudmap.config import SensorConfig, VolumeConfig
    from dudmap.volume import TsdfVolume

    volume = TsdfVolume(DEFAULT_CAMERA, VolumeConfig(voxel_size=0.005), SensorConfig(), 4.0)
    volume.look_at(np.eye(4))
    cells = np.arange(70_000, dtype=np.int32)
    assert np.array_equal(volume._entries_of(cells), cells)
    assert np.array_equal(volume._entries_of(cells[::-1].copy()), cells[::-1]), "found again, not made again"
