"""Rows move between host and device in the order in which they were written."""

import numpy as np
import pytest

from dudmap.gpu.device import make_backend
from dudmap.kernels.backend import OPERATIONS
from dudmap.kernels.mirror import Mirror

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from dudmap.gpu import faults, memory
from dudmap.gpu.backend import WarpBackend
from dudmap.gpu.memory import resident, wrote

ROWS = np.array([1, 3], dtype=np.int32)


@pytest.fixture
def mirror():
    return Mirror(np.arange(12, dtype=np.int32).reshape(4, 3).copy())


def write_on_device(mirror, rows, value):
    array = resident(mirror, "cpu")
    words = array.numpy()  # shares the memory of Warp's CPU device
    words[rows] = value
    wrote(mirror, "cpu", rows)


def test_the_device_has_memory_of_its_own(mirror):
    resident(mirror, "cpu").numpy()[0] = 99
    assert mirror.host[0, 0] == 0


def test_what_the_device_wrote_comes_down_when_it_is_read(mirror):
    write_on_device(mirror, ROWS, 70)
    assert mirror.stale[1, 0] == 3
    assert (mirror.take(np.array([1, 2]), np.array([0, 2])) == [70, 8]).all()
    assert mirror.stale[1, 0] == 3  # single elements bring no rows down
    assert (mirror.host[ROWS] == 70).all()
    assert (mirror.host[[0, 2]] == np.arange(12).reshape(4, 3)[[0, 2]]).all()


def test_the_last_writer_wins(mirror):
    write_on_device(mirror, ROWS, 70)
    mirror.fill(np.array([3]), 0)
    assert (mirror.host[1] == 70).all()
    assert (mirror.host[3] == 0).all()
    assert (resident(mirror, "cpu").numpy()[3] == 0).all()
    mirror.fill(np.array([2]), 5)
    write_on_device(mirror, np.array([2], dtype=np.int32), 6)
    assert (mirror.host[2] == 6).all()


def test_growing_keeps_what_either_side_wrote(mirror):
    write_on_device(mirror, ROWS, 70)
    mirror.fill(np.array([0]), 8)
    mirror.grow(6, -1)
    assert len(resident(mirror, "cpu").numpy()) == 4  # spare rows take no memory there
    mirror.use(6)
    assert (resident(mirror, "cpu").numpy()[:, 0] == [8, 70, 6, 70, -1, -1]).all()
    assert (mirror.host[:, 0] == [8, 70, 6, 70, -1, -1]).all()


def test_everything_written_on_the_host_goes_up_at_once(mirror):
    resident(mirror, "cpu")
    mirror.host[:] = 4
    mirror.wrote()
    assert (resident(mirror, "cpu").numpy() == 4).all()


def test_kernels_write_to_mirrors_only():
    with pytest.raises(TypeError, match="mirrors"):
        wrote(np.zeros((2, 3), np.int32), "cpu", ROWS)


def test_the_back_end_has_every_operation():
    backend = WarpBackend("cpu")
    assert len(OPERATIONS) > 20
    assert [name for name in OPERATIONS if not callable(getattr(backend, name, None))] == []


def test_memory_is_asked_for_when_the_map_has_grown(mirror, monkeypatch):
    """To answer, the device must finish its work, also on the next frame."""
    asked = []
    monkeypatch.setattr(memory, "free_memory", lambda device: asked.append(device) or 1 << 40)
    resident(mirror, "cpu")
    asked.clear()
    assert [mirror.max_rows() for _ in range(5)] == [None] * 5
    assert len(asked) == 2
    mirror.grow(6, -1)
    mirror.use(6)
    resident(mirror, "cpu")
    asked.clear()
    assert [mirror.max_rows() for _ in range(5)] == [None] * 5
    assert len(asked) == 2
    monkeypatch.setattr(memory, "free_memory", lambda device: 10)
    mirror.grow(9, -1)
    mirror.use(9)
    monkeypatch.setattr(memory, "has_room", lambda num_bytes, device: True)
    resident(mirror, "cpu")
    with faults.told_to(lambda sentence: None):
        assert mirror.max_rows() is not None
