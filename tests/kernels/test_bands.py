"""Bands of work on several threads."""

import multiprocessing
import subprocess
import sys
import threading
import time
import weakref

import pytest

from dudmap.core.backends import threads


@pytest.fixture(autouse=True)
def four_threads(give_threads):
    """As on four cores, whatever this machine has."""
    give_threads(4)


def squares(count):
    return threads.run_bands(lambda start, stop, add: sum(range(start, stop)) + add, threads.bands(count, 3), range(34))


def test_results_are_in_order_and_each_band_runs_once():
    calls = []
    ranges = threads.bands(1000, 7)
    results = threads.run_bands(lambda start, stop: calls.append(start) or (start, stop), ranges)
    assert results == ranges
    assert sorted(calls) == [start for start, _ in ranges]


def test_other_threads_take_part():
    barrier = threading.Barrier(4, timeout=30)  # passed only by four at once
    names = threads.run_bands(lambda *_: barrier.wait() and threading.current_thread().name, [(n, n) for n in range(4)])
    assert len(names) == 4


def test_bands_within_bands_and_tasks_end():
    inner = squares(100)
    outer = threads.run_bands(lambda start, stop: squares(100), [(0, 1)] * 9)
    assert outer == [inner] * 9
    assert threads.submit(lambda: squares(100))() == inner


def test_an_error_reaches_the_caller_after_all_bands_have_ended():
    ended = []

    def function(start, stop):
        if start == 3:
            raise ValueError("band 3")
        ended.append(start)

    with pytest.raises(ValueError, match="band 3"):
        threads.run_bands(function, threads.bands(10, 1))
    assert sorted(ended) == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    with pytest.raises(ZeroDivisionError):
        threads.submit(lambda: 1 / 0)()


def test_what_no_thread_has_come_to_is_computed_once_by_who_asks():
    busy, goes_on, done = threading.Barrier(4, timeout=30), threading.Event(), []
    others = [threads.submit(lambda: busy.wait() and goes_on.wait(30)) for _ in range(3)]
    busy.wait()
    result = threads.submit(lambda: done.append(threading.get_ident()) or len(done))
    assert [result(), result()] == [1, 1]
    goes_on.set()
    for other in others:
        other()
    threads.submit(lambda: None)()
    assert done == [threading.get_ident()]


def test_what_a_task_holds_is_let_go_once_it_is_done():
    class Images:
        pass

    images = Images()
    held = weakref.ref(images)
    result = threads.submit(lambda images=images: type(images).__name__)
    assert result() == "Images"
    del images
    for _ in range(100):  # the other thread may still be about to come to it
        if held() is None:
            break
        time.sleep(0.01)
    assert held() is None
    assert result() == "Images"


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_what_bands_hold_is_let_go_while_the_threads_wait():
    class Data:
        pass

    data = Data()
    held = weakref.ref(data)
    threads.run_bands(lambda start, stop, data=data: (start, stop), threads.bands(100, 7))
    del data
    late = time.monotonic() + 30
    while held() is not None and time.monotonic() < late:
        time.sleep(0.01)
    assert held() is None


def test_a_forked_process_has_threads_of_its_own():
    expected = squares(100)
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=lambda: queue.put((squares(100), threads.submit(lambda: 7)())), daemon=True)
    child.start()
    child.join(30)
    assert child.exitcode == 0
    assert queue.get() == (expected, 7)


def test_the_interpreter_ends_after_what_its_threads_do():
    """A thread that is in compiled code then would end the process with an error."""
    program = (
        "import time\nfrom dudmap.core.backends import threads\n"
        "threads.submit(lambda: (time.sleep(0.3), print('done')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "done\n"
