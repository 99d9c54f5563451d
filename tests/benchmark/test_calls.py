"""Counts of what a frame costs besides arithmetic."""

import gc
from collections import Counter

import pytest

from dudmap import Config, synthetic
from dudmap.core.backends import threads
from dudmap.core.geometry.camera import Camera
from dudmap.lab.benchmark.calls import (
    BYTES_PER_PIXEL,
    BYTES_PER_READING,
    COUNTED_FROM,
    FrameCost,
    count_calls,
    memory_rate,
    stage_table,
    summary,
)

CAMERA = Camera(131.0, 131.0, 79.5, 59.5, 160, 120)
SMALL = Config().override(["volume.voxel_size=0.04", "preprocess.depth_max=4"])


@pytest.fixture(autouse=True)
def _kernels_are_listed():
    """``conftest`` hides the objects of earlier tests from the garbage collector, which lists the kernels."""
    gc.unfreeze()


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


def test_bytes_are_those_of_the_linearisations_and_of_the_fused_voxels():
    sequence = synthetic.sequence(frames=COUNTED_FROM + 3, camera=CAMERA, movers=())
    (cost,) = count_calls(sequence, SMALL, COUNTED_FROM + 3)
    again = cost.inside["track_again"]
    assert again["bytes"] % (BYTES_PER_PIXEL * 40 * 30) == 0, "whole images"
    assert again["launches"] >= 1
    assert cost.inside["integrate"]["bytes"] > BYTES_PER_READING * 160 * 120
    assert cost.inside["check"]["bytes"] == 0


def test_the_table_of_stages():
    first = Counter(kernel_us=1000, launches=2, barriers=1, bytes=4_000_000)
    second = Counter(kernel_us=2000, launches=4, barriers=1, bytes=8_000_000)
    stages = {"track": 3.0, "check": 0.5}, {"track": 5.0, "check": 1.5}
    costs = [FrameCost({}, {"track": inside}, times) for inside, times in zip((first, second), stages, strict=True)]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in stage_table(costs, 2e9).splitlines()[2:]]
    assert lines == [
        ["track", "4.00", "1.50", "2.50", "3", "1", "6.0", "3.00"],
        ["check", "1.00", "0.00", "1.00", "0", "0", "", ""],
    ]


def test_without_counted_frames_there_is_no_figure():
    assert summary([]) == {}
    assert len(stage_table([], 1.0).splitlines()) == 2


def test_memory_is_copied_at_a_rate_of_memory():
    assert 5e8 < memory_rate() < 5e12
