"""Work in bands on several threads, and calls beside it."""

import threading

import pytest

from dudmap.kernels import threads
from dudmap.kernels.threads import bands, beside, run_bands


@pytest.fixture(params=[1, 2, 4])
def cores(request, monkeypatch):
    monkeypatch.setenv("DUDMAP_THREADS", str(request.param))
    threads._pool.cache_clear()
    yield request.param
    threads._pool.cache_clear()


def total(start: int, stop: int) -> int:
    return sum(range(start, stop))


def test_bands_come_back_in_order(cores):
    assert run_bands(lambda start, stop: (start, stop), bands(10, 3)) == [(0, 3), (3, 6), (6, 9), (9, 10)]


def test_a_call_beside_may_use_bands_itself(cores):
    """Its own thread may be the only one of the pool: waiting for another would be for ever."""
    calls = [beside(lambda: sum(run_bands(total, bands(100, 7)))) for _ in range(3)]
    assert sum(run_bands(total, bands(1000, 10))) == sum(range(1000))
    assert [call.result(timeout=10) for call in calls] == [sum(range(100))] * 3


def test_bands_do_not_wait_for_a_call_beside_them(cores):
    """The calling thread does all bands if the others are taken."""
    if cores == 1:
        pytest.skip("with one core there is nothing beside")
    release = threading.Event()
    calls = [beside(release.wait, 10) for _ in range(cores - 1)]
    assert sum(run_bands(total, bands(1000, 10))) == sum(range(1000))
    assert not any(call.done() for call in calls)
    release.set()
    assert all(call.result(timeout=10) for call in calls)


def test_an_error_beside_arrives(cores):
    def fail() -> None:
        raise ValueError("what went wrong")

    call = beside(fail) if cores > 1 else None
    with pytest.raises(ValueError, match="what went wrong"):
        beside(fail) if call is None else call.result()
