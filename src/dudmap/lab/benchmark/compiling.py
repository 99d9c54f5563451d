"""``dudmap benchmark compile``: compiled kernels, seconds, callers."""

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from numba.core import config, event

from dudmap.core import shipped_kernels
from dudmap.lab.benchmark.measure import grid


class _Times(event.Listener):
    def __init__(self) -> None:
        self.rows: dict[str, dict[str, Any]] = {}
        self.part, self._open = "", list[float]()

    def on_start(self, event: event.Event) -> None:
        self._open.append(time.thread_time())

    def on_end(self, event: event.Event) -> None:
        start = self._open.pop()
        if self._open:
            return
        data: Any = event.data
        kernel = data["dispatcher"].py_func
        name = f"{kernel.__module__.removeprefix('dudmap.')}.{kernel.__qualname__}"
        row = self.rows.setdefault(name, {"seconds": 0.0, "types": 0, "part": self.part, "callers": Counter()})
        row["seconds"] += time.thread_time() - start
        row["types"] += 1
        row["callers"][_caller()] += 1


def _caller() -> str:
    own = {__name__, "dudmap.core.backends.cpu.teams", "dudmap.core.backends.threads", "dudmap.core.kernel_cache"}
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        name = str(frame.f_globals.get("__name__"))
        if name.startswith("dudmap.") and name not in own:
            return f"{name.rpartition('.')[2]}.{frame.f_code.co_qualname}"
    return ""


def compile_all(steps: list[tuple[str, Callable[[], object]]]) -> dict[str, Any]:
    """Compile all kernels into an empty folder, in a separate process.

    Returns:
        ``rows`` by kernel, longest first: ``seconds``, number of argument ``types``, first ``part`` that needs it,
        ``callers``.
    """
    times, settings = _Times(), cast(Any, config)
    event.register("numba:compile", times)
    with tempfile.TemporaryDirectory() as folder:
        settings.CACHE_DIR, shipped_kernels.FOLDER = folder, Path(folder) / "none"
        for times.part, step in steps:
            step()
    event.unregister("numba:compile", times)
    rows = sorted(times.rows.items(), key=lambda item: -item[1]["seconds"])
    return {"rows": {name: row | {"callers": sorted(row["callers"])} for name, row in rows}}


def compile_warmup(_: None = None) -> dict[str, Any]:
    """``compile_all`` of the steps of ``dudmap warmup``."""
    from dudmap.lab.warmup import steps

    return compile_all(steps())


def table(tree: dict[str, Any]) -> str:
    """Markdown table of the kernels, with the sum."""
    rows = tree["rows"]
    lines = [
        [name, row["part"], ", ".join(row["callers"]), str(row["types"]), f"{row['seconds']:.2f}"]
        for name, row in rows.items()
    ]
    total = [f"{len(rows)} kernels", "", "", str(sum(row["types"] for row in rows.values()))]
    lines.append([*total, f"{sum(row['seconds'] for row in rows.values()):.1f}"])
    return grid(["kernel", "first part", "called by", "types", "seconds"], lines, words=3)
