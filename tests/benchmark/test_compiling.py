"""The table of ``dudmap benchmark compile``."""

import numba
import numpy as np

from dudmap.core import shipped_kernels
from dudmap.core.backends import threads
from dudmap.lab.benchmark.compiling import compile_all, table


def test_each_kernel_has_its_time_its_types_and_its_callers(monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)  # both are restored afterwards
    monkeypatch.setattr(shipped_kernels, "FOLDER", shipped_kernels.FOLDER)

    @threads.scalar
    def squared(x):
        return x * x

    @threads.kernel
    def total(values):
        return squared(values[0])

    @threads.kernel
    def first(values):
        return values[0]

    def part():
        total(np.ones(2))
        total(np.ones(2))
        total(np.ones(2, np.float32))

    tree = compile_all([("one", part), ("other", lambda: (part(), first(np.ones(2))))])
    rows = {name.rpartition(".")[2]: row for name, row in tree["rows"].items()}
    parts = {name: (row["types"], row["part"]) for name, row in rows.items()}
    assert parts == {"total": (2, "one"), "first": (1, "other")}
    assert all(row["callers"] == [""] for row in rows.values())  # none of dudmap
    assert all(row["seconds"] > 0 for row in rows.values())
    assert list(rows) == sorted(rows, key=lambda name: -rows[name]["seconds"])
    assert table(tree).splitlines()[-1].startswith("| 2 kernels |  |  | 3 |")
