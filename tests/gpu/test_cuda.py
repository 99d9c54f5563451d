"""The tests of the streams on a GPU, where there is one: nothing is simulated, and nothing refuses."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dudmap.gpu.device import make_backend, make_clock, obstacle

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
pytestmark = pytest.mark.skipif(bool(obstacle()), reason=f"no GPU: {obstacle()}")
make_backend("warp-cpu")

from test_levels import everything
from test_streams import processed, same

from dudmap.gpu import faults, sequence
from dudmap.gpu.streams import main_queue, own_queue
from dudmap.stage_timer import StageTimer

NAME = "cuda:0"
CLOSE = 1e-3
"""Metres, or elements of a pose: other instructions round otherwise, which moves a registration up to its tolerance."""


@pytest.fixture(scope="module")
def told():
    sentences = []
    with faults.told_to(sentences.append):
        yield sentences


@pytest.fixture(scope="module")
def found(recording, told):
    return processed(NAME, recording)


def test_poses_are_those_of_the_cpu(recording, found, told):
    expected = processed("cpu", recording)
    poses = [(a, b) for a, b in zip(found, expected, strict=True) if np.shape(a) == (4, 4)]
    assert len(poses) == 9
    for a, b in poses:
        np.testing.assert_allclose(a, b, atol=CLOSE)
    assert told == []


def test_two_runs_are_equal(recording, found, told):
    assert same(processed(NAME, recording), found)
    assert told == []


def test_graphs_and_single_launches_are_equal(recording, found, told):
    with sequence.one_by_one():
        assert same(processed(NAME, recording), found)
    assert told == []
    assert not sequence._refusing


def test_another_thread_may_prepare(recording, found, told):
    for _ in range(5):
        with ThreadPoolExecutor(1) as reader:
            assert same(processed(NAME, recording, reader.submit), found)
    assert told == []


def test_maps_with_several_voxel_sizes_are_equal(recording, told):
    assert same(everything(recording, NAME), everything(recording, NAME))
    assert told == []


def test_queues_wait_for_each_other():
    import warp as wp

    main, own = main_queue(NAME), own_queue(NAME)
    big, small = wp.zeros(1 << 26, dtype=wp.float32, device=NAME), np.arange(5, dtype=np.float32)
    target = wp.empty(5, dtype=wp.float32, device=NAME)
    for _ in range(20):
        main.copy(big, wp.empty_like(big))
    main.copy(target, wp.array(small, device="cpu"))
    own.wait(main.record())
    np.testing.assert_array_equal(own.download(target), small)


def test_stages_are_measured():
    timer = StageTimer(clock=make_clock(NAME))
    with timer("nothing"):
        pass
    assert 0 <= timer.times()["nothing"] < 50
