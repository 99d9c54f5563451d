"""Terminal output of a run: a progress bar and a summary table."""

import logging
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from dudmap.app.doctor import COMPILING
from dudmap.app.terminal import stderr_console
from dudmap.core import kernel_cache

if TYPE_CHECKING:
    from dudmap.core.result import FrameResult
    from dudmap.errors import FrameError

log = logging.getLogger(__name__)

FIGURES = (
    ("  dropped", "dropped", "{}", 1),
    ("latency, median", "latency_ms_median", "{:.1f} ms", 1),
    ("latency, 95th percentile", "latency_ms_p95", "{:.1f} ms", 1),
    ("time per frame, median", "ms_per_frame_median", "{:.1f} ms", 1),
    ("time per frame, 95th percentile", "ms_per_frame_p95", "{:.1f} ms", 1),
    ("peak memory", "peak_rss_mb", "{:.0f} MB", 1),
    ("map", "map_bytes", "{:.1f} MB", 1e-6),
    ("mesh", "mesh_triangles", "{} triangles", 1),
    ("ATE RMSE", "ate_rmse_m", "{:.1f} mm", 1000),
    ("RPE RMSE, translation", "rpe_trans_rmse_m_per_s", "{:.1f} mm/s", 1000),
    ("RPE RMSE, rotation", "rpe_rot_rmse_deg_per_s", "{:.2f} deg/s", 1),
    ("mask IoU", "mask_iou_mean", "{:.3f}", 1),
)

NOT_FUSED = {
    "skipped_similar": "redundant view",
    "uncertain": "uncertain pose or labels",
    "blind": "without usable colour",
}
"""Why a tracked frame is not fused, by its key in metrics.json."""


class RunProgress:
    """Progress bar on a terminal's stderr: number, rate, dynamic share, state.

    Lost and unreadable frames are logged once per gap, in any case. ``total`` is None if unknown.
    """

    def __init__(self, total: int | None, *, bar: bool = True) -> None:
        self._bar = Progress(
            SpinnerColumn(),  # turns while kernels compile and no frame is finished
            TextColumn("frame"),
            MofNCompleteColumn(),
            BarColumn(),
            TextColumn("{task.fields[fps]:5.1f} fps"),
            TextColumn("{task.fields[dynamic]:4.0%} dynamic"),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(),
            console=stderr_console(),
            disable=not (bar and stderr_console().is_terminal),
        )
        self._task = self._bar.add_task("run", total=total, fps=0.0, dynamic=0.0, state="starting")
        self._times: deque[float] = deque(maxlen=30)
        self._lost = self._skipped = 0
        self._said: set[str] = set()

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def frame(self, index: int, result: "FrameResult", dropped: int | None = None, shed: str = "") -> None:
        """Show a frame, the frames dropped so far, and omitted work."""
        if self._skipped > 1:
            log.info("frame %d: readable again, %d skipped", index, self._skipped)
        self._skipped = 0
        if result.T_world_camera is None:
            if self._lost == 0:
                log.info("frame %d: lost, %s", index, result.verdict.reason)
            self._lost += 1
        elif self._lost:
            log.info("frame %d: tracked again, %d lost", index, self._lost)
            self._lost = 0
        self._times.append(time.perf_counter())
        seconds = self._times[-1] - self._times[0]
        state = f"[{'red' if result.T_world_camera is None else 'green'}]{result.status}[/]"
        if dropped:
            state += f", {dropped} dropped"
        if shed:
            state += f", {shed}"
        self._bar.update(
            self._task,
            completed=index + 1,
            fps=(len(self._times) - 1) / seconds if seconds > 0 else 0.0,
            dynamic=result.dynamic_share,
            state=state,
        )

    def skip(self, error: "FrameError") -> None:
        """Report the first of consecutive unusable frames."""
        if self._skipped == 0:
            log.warning("skipped: %s", error)
        self._skipped += 1

    def announce_compilation(self) -> None:
        """Log that kernels are compiled first, if none exists."""
        if kernel_cache.is_cold():
            log.info(COMPILING)

    def once(self, sentence: str) -> None:
        """Log a warning once."""
        if sentence not in self._said:
            self._said.add(sentence)
            log.warning(sentence)

    def working(self, what: str) -> None:
        """Show another activity."""
        self._bar.update(self._task, state=what)


def summary(metrics: dict[str, Any]) -> Table:
    """Table of the metrics of a run."""
    table = Table(title=str(metrics["sequence"]), show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column(justify="right")
    table.add_row("frames", str(metrics["frames"]))
    for key in ("tracked", "repeated", "fused"):
        table.add_row(f"  {key}", str(metrics[key]))
    if unused := metrics["tracked"] - metrics["fused"]:
        table.add_row("  tracked, not fused", f"{unused}{_reasons(metrics)}")
    for key in ("lost", "unreadable"):
        table.add_row(f"  {key}", Text(str(metrics[key]), "red" if metrics[key] else ""))
    for label, key, form, factor in FIGURES:
        if key in metrics:
            value = metrics[key]
            table.add_row(label, "unknown" if value is None else form.format(value * factor))
        if key == "mesh_triangles" and "bodies" in metrics:
            rigid = sum(body["rigid"] for body in metrics["bodies"])
            table.add_row("object meshes", f"{rigid} of {len(metrics['bodies'])} moving objects are rigid")
    return table


def outcome(metrics: dict[str, Any], out: Path) -> str:
    """Last line of a run: folder, completeness, accuracy, and the command to show it."""
    found = [f"the poses of {metrics['tracked'] + metrics['repeated']} of {metrics['frames']} frames"]
    if triangles := metrics["mesh_triangles"]:
        found.append(f"a mesh of {triangles} triangles")
    if metrics.get("ate_rmse_m") is not None:
        found.append(f"ATE {1000 * metrics['ate_rmse_m']:.1f} mm")
    page = out / "report.html"
    return f"written to {out}: {', '.join(found)}; next: {f'open {page}' if page.exists() else f'dudmap report {out}'}"


def _reasons(metrics: dict[str, Any]) -> str:
    said = [f"{metrics[key]} {why}" for key, why in NOT_FUSED.items() if metrics[key]]
    if omitted := metrics.get("shed", {}).get("fusion"):
        said.append(f"{omitted} for lack of time")
    return f" ({', '.join(said)})" if said else ""
