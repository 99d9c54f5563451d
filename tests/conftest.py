"""Settings of the test processes (pytest-xdist's workers; OpenCV's for tests/processors.py), shared fixtures."""

import gc
import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from fake_slam import FakeSlam

worker = os.environ.get("PYTEST_XDIST_WORKER")
if worker is not None:
    # The workers share the kernels that "make test" has compiled while it checked the sources. Two processes write no
    # file of one name (dudmap.core.kernel_cache); a form that one deletes from the index is compiled again.
    os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).parents[1] / ".numba_cache" / "common"))
    # The cores are shared by the workers. The first one has at least two threads, so that whole systems run on several;
    # more threads than cores cost a tenth of the time. What threads share has tests with given numbers of them.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    fewest = 2 if worker == "gw0" else 1
    os.environ.setdefault("DUDMAP_THREADS", str(max(fewest, cores // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))))

if os.environ.get("DUDMAP_OPENCV_OPTIMIZED") == "0":
    import cv2

    cv2.setUseOptimized(False)


def pytest_addoption(parser):
    parser.addoption("--costs", action="store_true", help="print the processor seconds of each test file")


def pytest_collection_finish():
    gc.freeze()


def pytest_configure(config):
    if config.getoption("--costs"):
        from costs import Costs

        config.pluginmanager.register(Costs())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """Free the systems of each test, which refer to themselves: Python seldom does while so many objects live.

    After each file all objects that are left are no longer examined.
    """
    found = yield
    gc.collect()
    if nextitem is None or nextitem.path != item.path:
        gc.freeze()
    return found


@pytest.fixture(autouse=True)
def float_errors_are_errors():
    """Division by zero, overflow and invalid operations raise. Underflow to zero is rounding and allowed.

    Threads do not inherit this; there NumPy warns, and warnings are errors (pyproject.toml).
    """
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        yield


@pytest.fixture
def give_threads(monkeypatch):
    """Sets the number of threads of a test."""
    from dudmap.core.backends import threads

    def give(count):
        monkeypatch.setenv("DUDMAP_THREADS", str(count))
        threads.num_threads.cache_clear()
        threads._tasks.cache_clear()

    yield give
    threads.num_threads.cache_clear()
    threads._tasks.cache_clear()


@pytest.fixture
def slam(monkeypatch):
    """Replace ``dudmap.core.slam.Slam`` by ``FakeSlam``; tests set ``slam.script``."""
    fake = type("Slam", (FakeSlam,), {"script": {}})
    module = types.ModuleType("dudmap.core.slam")
    module.Slam = fake
    monkeypatch.setattr("dudmap.lab.warmup.steps", lambda: [("colour camera", lambda: None)])  # needs the real one
    monkeypatch.setitem(sys.modules, "dudmap.core.slam", module)
    monkeypatch.setattr("dudmap.app.pipeline.storing.RunStore.take", lambda *args, **options: None)
    return fake
