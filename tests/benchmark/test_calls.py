"""Counts of what a frame costs besides arithmetic."""

from dudmap import Config, synthetic
from dudmap.core.backends import threads
from dudmap.core.geometry.camera import Camera
from dudmap.lab.benchmark.calls import COUNTED_FROM, count_calls, summary

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SMALL = Config().override(["volume.voxel_size=0.04", "preprocess.depth_max=4"])


def test_the_calls_of_each_frame_are_counted():
    sequence = synthetic.sequence(frames=COUNTED_FROM + 3, camera=CAMERA, movers=())
    counts = count_calls(sequence, SMALL, COUNTED_FROM + 2)
    assert len(counts) == 2
    for one in counts:
        assert 5 < one["launches"] < one["calls"]
        assert (0 < one["barriers"]) == (threads.num_threads() > 1)
        assert one["barriers"] < one["launches"]
        assert one["files"] > 10
    assert summary(counts)["launches"] == sum(one["launches"] for one in counts) / 2


def test_without_counted_frames_there_is_no_figure():
    assert summary([]) == {}
