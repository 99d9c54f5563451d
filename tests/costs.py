"""``pytest --costs``: processor seconds of each test file, with its child processes, and the memory of its worker.

Compilation by Numba, data (fixtures) and work are counted apart. Children count as a whole.
"""

import os
import resource
import threading
import time
from collections import defaultdict

import numba.core.event
import pytest

COLUMNS = "compile", "data", "work", "children"


def spent():
    times = os.times()
    return time.process_time(), times.children_user + times.children_system


class Compilation(numba.core.event.Listener):
    """Processor seconds of each kernel that was compiled, with the functions that it inlines."""

    def __init__(self):
        self.seconds, self.inside = defaultdict(float), threading.local()

    def on_start(self, event):
        self.inside.__dict__.setdefault("begun", []).append(time.thread_time())

    def on_end(self, event):
        begin = self.inside.begun.pop()
        if not self.inside.begun:
            function = event.data["dispatcher"].py_func
            self.seconds[f"{function.__module__.rpartition('.')[2]}.{function.__name__}"] += time.thread_time() - begin


class Costs:
    """Adds costs to the reports in the worker, and prints their sums in the process that collects the reports."""

    def __init__(self):
        self.compilation = Compilation()
        numba.core.event.register("numba:compile", self.compilation)
        self.last = spent()
        self.files, self.tests = defaultdict(lambda: [0.0] * 4), defaultdict(float)
        self.peaks, self.kernels = defaultdict(int), defaultdict(float)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        now = spent()
        own, children = (a - b for a, b in zip(now, self.last, strict=True))
        self.last = now
        report.kernels = dict(self.compilation.seconds)
        self.compilation.seconds.clear()
        compiled = sum(report.kernels.values())
        report.costs = [compiled, own - compiled, children]
        report.peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        return report

    def pytest_runtest_logreport(self, report):
        compiled, own, children = report.costs
        file, row = report.nodeid.split("::")[0], [compiled, 0.0, 0.0, children]
        row[1 + (report.when == "call")] = own
        self.files[file] = [a + b for a, b in zip(self.files[file], row, strict=True)]
        self.tests[report.nodeid] += compiled + own + children
        self.peaks[file] = max(self.peaks[file], report.peak)
        for name, seconds in report.kernels.items():
            self.kernels[f"{name} ({file})"] += seconds

    def pytest_terminal_summary(self, terminalreporter):
        terminalreporter.section("processor seconds")
        order = sorted(self.files, key=lambda file: -sum(self.files[file]))
        sums = [sum(column) for column in zip(*self.files.values(), strict=True)]
        rows = [("file", ["all", *COLUMNS], "peak MB"), ("all", [sum(sums), *sums], max(self.peaks.values()))]
        rows += [(file, [sum(self.files[file]), *self.files[file]], self.peaks[file]) for file in order]
        for file, row, peak in rows:
            cells = (f"{x:9.2f}" if isinstance(x, float) else f"{x:>9}" for x in row)
            terminalreporter.write_line("".join(cells) + f"{peak:>9}  {file}")
        for title, seconds in (("test", self.tests), ("compiled kernel", self.kernels)):
            terminalreporter.write_line(f"\n      all  {title}")
            for name in sorted(seconds, key=lambda name: -seconds[name])[:25]:
                terminalreporter.write_line(f"{seconds[name]:9.2f}  {name}")
