"""A recording on a GPU, where there is one: nothing is simulated."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from dudmap.config import Config
from dudmap.core.backends.device import obstacle
from dudmap.core.slam import Slam
from small_maps import CAMERA

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
pytestmark = pytest.mark.skipif(bool(obstacle()), reason=f"no GPU: {obstacle()}")

CLOSE = 1e-3
"""Metres, or elements of a pose: other instructions round otherwise, which moves a registration up to its tolerance."""


def poses(device, recording, prepare=None):
    slam = Slam(CAMERA, Config().override([f"device={device}", "volume.voxel_size=0.03"]))
    prepare = prepare or (lambda frame: slam.prepare(frame))
    for index in range(len(recording)):
        slam.process(prepare(recording[index]))
    return slam.trajectory.Ts_world_camera


def test_poses_are_those_of_the_cpu(recording):
    np.testing.assert_allclose(poses("cuda", recording), poses("cpu", recording), atol=CLOSE)


def test_two_runs_are_equal(recording):
    assert np.array_equal(poses("cuda", recording), poses("cuda", recording))


def test_another_thread_may_prepare(recording):
    slam = Slam(CAMERA, Config().override(["device=cuda", "volume.voxel_size=0.03"]))
    with ThreadPoolExecutor(1) as reader:
        views = [reader.submit(slam.prepare, recording[index]) for index in range(len(recording))]
        for view in views:
            slam.process(view.result())
    assert np.array_equal(slam.trajectory.Ts_world_camera, poses("cuda", recording))
