"""Inputs for the kernels of the GPU, which run on Warp's CPU device here."""

import numpy as np
import pytest

from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.device import make_backend
from dudmap.lab.synthetic import sequence
from small_maps import CAMERA, integrated


@pytest.fixture(scope="session")
def recording():
    return sequence(frames=6, camera=CAMERA)


@pytest.fixture(scope="session")
def gpu():
    return make_backend("warp-cpu")


@pytest.fixture(scope="session")
def cpu():
    return CpuBackend()


@pytest.fixture(scope="session")
def depth(recording):
    """A depth image with small holes and large ones."""
    holes = np.random.default_rng(3).random((120, 160))
    out = recording[0].depth.astype(np.float32)
    out[holes < 0.02] = 0
    out[30:40, 50:70] = 0
    return out


@pytest.fixture(scope="session")
def maps(recording):
    """The same frames in a map on the CPU and in one on the device."""
    return [integrated(recording, name) for name in ("cpu", "warp-cpu")]
