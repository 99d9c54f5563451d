"""Rows move between host and device in the order in which they were written."""

import numpy as np
import pytest

from dudmap.core.backends.mirror import Mirror

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from dudmap.core.backends.warp.memory import resident, wrote

NAME, ROWS = "warp-cpu", np.array([1, 3], dtype=np.int32)


@pytest.fixture
def mirror():
    return Mirror(np.arange(12, dtype=np.int32).reshape(4, 3).copy())


def write_on_device(mirror, rows, value):
    words = resident(mirror, NAME).numpy()  # shares the memory of Warp's CPU device
    words[rows] = value
    wrote(mirror, rows)


def test_the_device_has_memory_of_its_own(mirror):
    resident(mirror, NAME).numpy()[0] = 99
    assert mirror.host[0, 0] == 0


def test_what_the_device_wrote_comes_down_when_it_is_read(mirror):
    write_on_device(mirror, ROWS, 70)
    assert mirror.array[1, 0] == 3
    assert (mirror.host[ROWS] == 70).all()
    assert (mirror.host[[0, 2]] == np.arange(12).reshape(4, 3)[[0, 2]]).all()


def test_the_last_writer_wins(mirror):
    write_on_device(mirror, ROWS, 70)
    mirror.fill(np.array([3]), 0)
    assert (mirror.host[1] == 70).all()
    assert (mirror.host[3] == 0).all()
    assert (resident(mirror, NAME).numpy()[3] == 0).all()
    mirror.fill(np.array([2]), 5)
    write_on_device(mirror, np.array([2], dtype=np.int32), 6)
    assert (mirror.host[2] == 6).all()


def test_growing_keeps_what_either_side_wrote(mirror):
    write_on_device(mirror, ROWS, 70)
    mirror.fill(np.array([0]), 8)
    mirror.grow(9)
    assert len(resident(mirror, NAME).numpy()) == 4  # spare rows take no memory there
    write_on_device(mirror, np.array([2], dtype=np.int32), 71)
    mirror.used = 5
    mirror.fill(np.array([4]), 9)
    assert (resident(mirror, NAME).numpy()[:5, 0] == [8, 70, 71, 70, 9]).all()
    assert (mirror.host[:, 0] == [8, 70, 71, 70, 9, 0, 0, 0, 0]).all()


def test_everything_written_on_the_host_goes_up_at_once(mirror):
    resident(mirror, NAME)
    mirror.host[:] = 4
    mirror.wrote()
    assert (resident(mirror, NAME).numpy() == 4).all()


def test_kernels_write_to_mirrors_only():
    with pytest.raises(TypeError, match="mirrors"):
        wrote(np.zeros((2, 3), np.int32), ROWS)
