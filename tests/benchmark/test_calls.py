"""Counts of what a frame costs besides arithmetic."""

from dudmap import Config, synthetic
from dudmap.core.backends import threads
from dudmap.core.geometry.camera import Camera
from dudmap.lab.benchmark.calls import COUNTED_FROM, FrameCost, count_calls, stage_table, summary

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SMALL = Config().override(["volume.voxel_size=0.04", "preprocess.depth_max=4"])


def test_the_calls_of_each_frame_are_counted():
    sequence = synthetic.sequence(frames=COUNTED_FROM + 5, camera=CAMERA, movers=())
    costs = count_calls(sequence, SMALL, COUNTED_FROM + 5)
    assert len(costs) == 2
    for one in (cost.counts for cost in costs):
        assert 5 < one["launches"] < one["calls"]
        assert (0 < one["barriers"]) == (threads.num_threads() > 1)
        assert one["barriers"] < one["launches"]
        assert one["files"] > 10
    assert summary(costs)["launches"] == sum(cost.counts["launches"] for cost in costs) / 2


def test_the_time_of_a_stage_is_that_in_kernels_and_around_them():
    kernels, stages = ({"track": 1.0}, {"track": 2.0}), ({"track": 3.0, "check": 0.5}, {"track": 5.0, "check": 1.5})
    costs = [FrameCost({}, *times) for times in zip(kernels, stages, strict=True)]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in stage_table(costs).splitlines()[2:]]
    assert lines == [["track", "4.00", "1.50", "2.50"], ["check", "1.00", "0.00", "1.00"]]


def test_without_counted_frames_there_is_no_figure():
    assert summary([]) == {}
    assert len(stage_table([]).splitlines()) == 2
