"""Tables of figures as Markdown, CSV and JSON."""

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dudmap.lab.benchmark.measure import Row


class Column(NamedTuple):
    """Format of one figure: heading with unit, factor from the stored unit, number of decimals."""

    key: str
    heading: str
    factor: float = 1.0
    digits: int = 0


COLUMNS = (
    Column("frames", "frames"),
    Column("lost", "lost"),
    Column("ate_rmse_m", "ATE RMSE, mm", 1000, 1),
    Column("rpe_trans_rmse_m_per_s", "RPE, mm/s", 1000, 1),
    Column("rpe_rot_rmse_deg_per_s", "RPE, deg/s", 1, 2),
    Column("drift_rmse_m", "drift RMSE, mm", 1000, 1),
    Column("rotation_rmse_deg", "rotation RMSE, deg", 1, 2),
    Column("mask_iou_mean", "mask IoU", 1, 3),
    Column("mesh_accuracy_m", "accuracy, mm", 1000, 1),
    Column("mesh_completeness", "completeness, %", 100, 1),
    Column("ghost_area_m2", "ghost, m2", 1, 3),
    Column("ms_per_frame_median", "ms/frame", 1, 1),
    Column("ms_per_frame_p95", "p95 ms", 1, 1),
    Column("cpu_s", "CPU s", 1, 1),
    Column("peak_rss_mb", "peak MB"),
)
"""Columns of a suite; those without any value are omitted."""


def shown(value: Any, column: Column) -> str:  # noqa: ANN401 - figures and words alike
    """Text of one cell."""
    if value is None:
        return ""
    return f"{value * column.factor:.{column.digits}f}" if isinstance(value, int | float) else str(value)


def grid(header: Sequence[str], rows: Iterable[Sequence[str]], words: int = 2) -> str:
    """Markdown table; the first ``words`` columns are left-aligned, the others right-aligned."""
    lines = ["| " + " | ".join(header) + " |"]
    lines.append("|" + "|".join("---" if number < words else "---:" for number in range(len(header))) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def markdown(rows: Sequence[Row], columns: Sequence[Column] = COLUMNS) -> str:
    """Markdown table of the rows, followed by a list of the failed ones."""
    good = [row for row in rows if "error" not in row]
    used = [column for column in columns if any(row.get(column.key) is not None for row in good)]
    header = ["sequence", "system", *(column.heading for column in used)]
    body = [
        [str(row["sequence"]), str(row["system"]), *(shown(row.get(column.key), column) for column in used)]
        for row in good
    ]
    failed = [f"- {row['sequence']}, {row['system']}: {row['error']}" for row in rows if "error" in row]
    return grid(header, body) + ("\n" + "\n".join(failed) + "\n" if failed else "")


def save(rows: Sequence[Row], text: str, out: Path, name: str, more: dict[str, Any] | None = None) -> None:
    """Write <name>.md, <name>.csv and <name>.json into a folder, in stored units."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    keys = list(dict.fromkeys(key for row in rows for key in row))
    with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, keys, restval="")
        writer.writeheader()
        writer.writerows(rows)
    content = {**(more or {}), "rows": list(rows)}
    (out / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
