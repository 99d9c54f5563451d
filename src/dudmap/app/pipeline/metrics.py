"""Metrics of a run, collected frame by frame."""

import csv
import io
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.environment import peak_rss_mb
from dudmap.atomic_file import atomic_file, write_text
from dudmap.config import Config
from dudmap.core.result import FrameResult
from dudmap.core.shed import Shed
from dudmap.core.state import CACHE
from dudmap.evaluation.segmentation import SCORED_COVERAGE, mask_iou

if TYPE_CHECKING:
    from dudmap.core.frames.frame import Frame
    from dudmap.core.objects.object_tracker import Mover
    from dudmap.errors import FrameError

STRIDE = 4
COUNTED = ("fused", "skipped_similar", "relocalized", "corrected", "blind", "colorless", "uncertain", "degenerate")


@dataclass
class RunRecord:
    """Metrics of the frames processed so far.

    Attributes:
        rows: Per frame: timestamp, state, total and reading time, stages, ms.
        unreadable: A sentence per unusable frame.
        checks: Figure and limit of all checks (``core/tracking/checks.py``).
        repeated: Repeating frames by the repeated part.
        rejected: Frames rejected for a fault of the stream, by kind; readable ones are lost as well.
        mask_ious: Intersection over union of the mask, per frame with enough true coverage.
        movers: Lines of movers.jsonl.
        residuals: (BINS,) histogram of normalised residuals (``dynamics.masks``), or 0.
        readings: Measurements in every fourth row and column: all, below and above the depth range.
        depth_limits: Used depths, metres.
        counts: Numbers of frames by kind.
        spent: Seconds, and processor seconds, before this process or pass.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    lost: list[dict[str, Any]] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    checks: list[dict[str, Any]] = field(default_factory=list)
    repeated: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    mask_ious: list[float] = field(default_factory=list)
    movers: list[str] = field(default_factory=list)
    residuals: NDArray[np.int64] = field(default_factory=lambda: np.zeros((), dtype=np.int64))
    readings: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("all", "too_near", "too_far"), 0))
    depth_limits: tuple[float, float] = Config().depth_limits
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    warnings: list[str] = field(default_factory=list)
    masked: int | None = None
    dropped: int | None = None
    spent: tuple[float, float] = (0.0, 0.0)
    _since: tuple[float, float] = field(
        default_factory=lambda: (time.perf_counter(), time.process_time()), metadata=CACHE
    )

    def elapsed(self) -> tuple[float, float]:
        """Seconds, and processor seconds, without gaps between processes."""
        (wall, cpu), (wall_since, cpu_since) = self.spent, self._since
        return wall + time.perf_counter() - wall_since, cpu + time.process_time() - cpu_since

    def settle(self) -> None:
        """Record the time so far."""
        self.spent, self._since = self.elapsed(), (time.perf_counter(), time.process_time())

    def add(
        self,
        result: FrameResult,
        total_ms: float,
        reading_ms: float,
        mask: NDArray[np.bool_] | None,
        **delays: float,
    ) -> None:
        """Add a frame with its times (ms) and true mask (H, W), if known.

        Live ``delays``: frames ``dropped`` before, ``latency`` from arrival to result, ms, and ``shed``.
        """
        frame = {"timestamp": f"{result.timestamp:.6f}", "state": str(result.status)}
        times = {"reading": reading_ms, "total": total_ms} | delays | result.timings
        row: dict[str, Any] = frame | {
            "fused": int(result.fused),
            "dynamic_share": round(result.dynamic_share, 4),
            **{name: round(value, 3) for name, value in times.items()},
        }
        self.rows.append(row)
        for name in ("fused", "blind", "uncertain"):
            self.counts[name] += bool(getattr(result, name))
        for name in ("relocalized", "corrected"):
            self.counts[name] += name in result.events
        self.counts["skipped_similar"] += "redundant" in result.verdict
        self.counts["degenerate"] += result.verdict.figure("unobservable") > 0
        for part in ("frame", "depth", "color"):
            if result.verdict.figure(f"{part}_repeats") > 0:
                self.repeated[part] = self.repeated.get(part, 0) + 1
        self.checks.append(frame | _columns(result))
        if result.T_world_camera is None:
            self.lost.append({"timestamp": result.timestamp, "reason": result.verdict.reason})
        if result.status == "rejected":
            self._reject(result.verdict.failed[0].name)
        if result.histogram is not None:
            self.residuals = self.residuals + result.histogram
        if mask is not None and mask.mean() > SCORED_COVERAGE:
            self.mask_ious.append(mask_iou(result.dynamic_mask, mask))

    def add_readings(self, frame: "Frame") -> None:
        """Count measurements in and outside the depth range, and frames without colour."""
        depth = frame.depth
        self.counts["colorless"] += frame.color is None
        least, largest = self.depth_limits
        some = depth[::STRIDE, ::STRIDE]
        self.readings["all"] += int(np.count_nonzero(some > 0))
        self.readings["too_near"] += int(np.count_nonzero((some > 0) & (some < least)))
        self.readings["too_far"] += int(np.count_nonzero(some > largest))

    def add_movers(self, row: dict[str, Any], result: FrameResult) -> None:
        """Add moving objects to a row of ``rows``, in order; another thread may add later frames."""
        start, movers = time.perf_counter(), result.movers
        if movers:
            line = {"timestamp": result.timestamp, "movers": [_row(mover) for mover in movers]}
            self.movers.append(json.dumps(line))
        row["movers"] = round(1000 * (time.perf_counter() - start), 3)

    def skip(self, error: "FrameError") -> None:
        """Count a frame that cannot be read or used."""
        self.unreadable.append(str(error))
        self._reject(error.kind)

    def _reject(self, kind: str) -> None:
        self.rejected[kind] = self.rejected.get(kind, 0) + 1

    def save_timings(self, path: Path) -> None:
        """Write a CSV row per frame, a column per stage, milliseconds."""
        _write_table(path, self.rows, "0")

    def save_checks(self, path: Path) -> None:
        """Write a CSV row per registered frame; unknown values are empty."""
        _write_table(path, self.checks, "")

    def save_movers(self, path: Path) -> None:
        """Write JSON lines, one per frame with moving objects."""
        write_text(path, "".join(f"{line}\n" for line in self.movers))

    def save_residuals(self, path: Path) -> None:
        """Write an NPZ file with the histogram of all residuals and its mixture, if any.

        Arrays: ``edges`` (BINS + 1,), standard deviations, ``counts`` (BINS,), ``prior`` (2,) and ``sigma`` (2,),
        static and dynamic (thesis eq. 4.56).
        """
        from dudmap.core.backends.cpu.evidence import EDGES
        from dudmap.core.dynamics.masks import fit_mixture

        if not self.residuals.any():
            return
        mixture = fit_mixture(self.residuals, EDGES)
        with atomic_file(path) as file:
            np.savez(file, edges=EDGES, counts=self.residuals, prior=mixture.prior, sigma=mixture.sigma)

    def metrics(self) -> dict[str, Any]:
        """Counts and times under the keys of metrics.json."""
        totals, readings, shares = (self._column(name) for name in ("total", "reading", "dynamic_share"))
        out: dict[str, Any] = {
            "frames": len(self.rows) + len(self.unreadable),
            "tracked": sum(row["state"] == "tracked" for row in self.rows),
            "repeated": sum(row["state"] == "repeated" for row in self.rows),
            **self.counts,
            "fused": self.counts["fused"],
            "lost": len(self.lost),
            "unreadable": len(self.unreadable),
            "frames_rejected": dict(sorted(self.rejected.items())),
            "images_repeated": dict(sorted(self.repeated.items())),
            "ms_per_frame_median": _number(np.median(totals)),
            "ms_per_frame_p95": _number(np.percentile(totals, 95)),
            "ms_reading_median": _number(np.median(readings)),
            "peak_rss_mb": peak_rss_mb(),
            "dynamic_share_mean": _number(np.mean(shares), 4),
            "readings": {
                key: round(self.readings[key] / max(self.readings["all"], 1), 4) for key in ("too_near", "too_far")
            },
            "warnings": self.warnings,
            "lost_frames": self.lost,
            "unreadable_frames": self.unreadable,
        }
        if self.masked is not None:
            out |= {"frames_with_mask": self.masked, "frames_without_mask": len(self.rows) - self.masked}
        if self.mask_ious:
            out |= {"mask_iou_mean": _number(np.mean(self.mask_ious), 4), "mask_iou_frames": len(self.mask_ious)}
        if self.dropped is not None:
            latencies, shed = self._column("latency"), np.array([row["shed"] for row in self.rows], int)
            out |= {
                "dropped": self.dropped,
                "shed": {
                    name.lower(): int(np.count_nonzero(shed & step)) for name, step in Shed.__members__.items() if step
                },
                "latency_ms_median": _number(np.median(latencies)),
                "latency_ms_p95": _number(np.percentile(latencies, 95)),
            }
        return out

    def _column(self, name: str) -> NDArray[np.float64]:
        return np.array([row[name] for row in self.rows] or [np.nan])


def _write_table(path: Path, rows: list[dict[str, Any]], missing: str) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval=missing)
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def _columns(result: FrameResult) -> dict[str, Any]:
    verdict, covariance = result.verdict, result.covariance
    figures = dict[str, float]()
    if covariance is not None:
        figures["sigma_t_mm"] = 1000 * np.sqrt(np.trace(covariance[:3, :3]))
        figures["sigma_r_deg"] = np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))
    for one in verdict.outcomes:
        figures |= {one.name: one.figure, f"{one.name}_{'min' if one.at_least else 'max'}": one.limit}
    overruled = (f"{one.name}: {one.overruled_by}" for one in verdict.outcomes if one.overruled_by)
    return {
        **{name: float(f"{value:.7g}") if np.isfinite(value) else "" for name, value in figures.items()},
        "failed": "; ".join(one.name for one in verdict.failed),
        "overruled": "; ".join(overruled),
    }


def _row(mover: "Mover") -> dict[str, Any]:
    return {
        "id": mover.id,
        "centroid": mover.centroid.round(4).tolist(),
        "box": mover.box.round(4).tolist(),
        "velocity": mover.velocity.round(4).tolist(),
        "speed": round(mover.speed, 4),
        "age": round(mover.age, 4),
        "pixels": int(np.count_nonzero(mover.mask)),
    }


def _number(value: float | np.floating, digits: int = 3) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
