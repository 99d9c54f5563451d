import threading
import time

import pytest

from dudmap.app.pipeline.background import POSTPONED, WAITING, Background


def test_jobs_are_done_in_order_in_one_other_thread():
    done, threads = [], set()

    def job(n):
        time.sleep(0.01 * (n % 2))
        done.append(n)
        threads.add(threading.get_ident())

    with Background() as background:
        for n in range(8):
            background.do(lambda n=n: job(n))
    assert done == list(range(8))
    assert len(threads) == 1
    assert threading.get_ident() not in threads


def test_few_jobs_wait_and_all_can_be_waited_for():
    goes_on, done = threading.Event(), []
    with Background() as background:
        for n in range(WAITING + 1):
            background.do(lambda n=n: (goes_on.wait(), done.append(n)))
        threading.Timer(0.05, goes_on.set).start()
        background.do(lambda: done.append("last"))
        assert done[0] == 0
        background.wait()
        assert done == [*range(WAITING + 1), "last"]


def test_an_error_reaches_whoever_waits():
    with pytest.raises(ZeroDivisionError), Background() as background:
        background.do(lambda: 1 / 0)


def test_an_error_of_the_caller_is_not_replaced():
    def fail(background):
        with background:
            background.do(lambda: 1 / 0)
            raise KeyError("first")

    with pytest.raises(KeyError, match="first") as raised:
        fail(Background())
    assert "ZeroDivisionError" in raised.value.__notes__[0]


def test_postponed_jobs_are_done_when_the_caller_has_time_and_at_the_end():
    done = []
    with Background(postponed=True) as background:
        for n in range(POSTPONED + 2):
            background.do(lambda n=n: done.append((n, threading.get_ident())))
        assert done == [(0, threading.get_ident())], "too many waited"
        assert background.next()
        assert [n for n, _ in done] == [0, 1]
    assert [n for n, _ in done] == list(range(POSTPONED + 2))
    assert not background.next()


def test_postponed_jobs_are_done_when_the_caller_is_interrupted():
    done = []

    def interrupted():
        with Background(postponed=True) as background:
            background.do(lambda: done.append(1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert done == [1]
