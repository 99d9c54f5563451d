"""Figures of the development recordings, compared with their targets.

    python benchmarks/recordings.py --data FOLDER [--systems dudmap,none] [--only fr1_xyz_static] [--out DIR]
    python benchmarks/recordings.py --data FOLDER --columns color

Runs every system on every recording of a folder, one after the other, each in its own process. The semi-synthetic
recordings fr1_xyz_static, fr1_xyz_confusao, pan_confusao and ist_confusao (by folder name) have targets; others are
scored only. Prints the table and writes recordings.md, .csv and .json. With ``--columns color`` the columns are the
default, the registration with and without the colour term, and the better of these two.
"""

import argparse
from pathlib import Path

from dudmap.app.pipeline.environment import machine, versions
from dudmap.config import Config
from dudmap.lab.benchmark.color_columns import color_table, measure_columns
from dudmap.lab.benchmark.entries import local_entries
from dudmap.lab.benchmark.measure import Job, Row, measure_all
from dudmap.lab.benchmark.systems import systems
from dudmap.lab.benchmark.table import COLUMNS, Column, grid, markdown, save

TWINS = {"fr1_xyz_confusao": "fr1_xyz_static"}
"""Recordings of the same frames without people."""
TARGETS: dict[str, list[tuple[str, str, float, str]]] = {
    "fr1_xyz_static": [("ate_rmse_m", "ATE RMSE, m", 0.012, "<=")],
    "fr1_xyz_confusao": [
        ("twin_ratio", "ATE against the static twin", 1.25, "<="),
        ("lost", "frames lost", 0, "<="),
        ("mask_iou_mean", "mean mask IoU where people cover > 5 %", 0.7, ">="),
    ],
    "pan_confusao": [("rotation_rmse_deg", "rotation RMSE, deg", 2.0, "<=")],
    "ist_confusao": [("drift_rmse_m", "translation RMSE from the first frame, m", 0.015, "<=")],
}
"""Key, meaning, bound and direction of the targets, by recording."""
COMPARED = {
    "pan_confusao": Column("rotation_rmse_deg", "rotation RMSE, deg", 1, 3),
    "ist_confusao": Column("drift_rmse_m", "drift RMSE, mm", 1000, 2),
}
"""Figure of ``--columns color`` of the recordings whose ATE says little."""
EVERYWHERE = [("ms_per_frame_median", "ms per frame, median", 100.0, "<="), ("peak_rss_mb", "peak MB", 2000.0, "<=")]


def with_twins(rows: list[Row]) -> None:
    """Add the ratio of the ATE to that of the same system on the same frames without people."""
    ates = {(row["sequence"], row["system"]): row.get("ate_rmse_m") for row in rows}
    for row in rows:
        twin = ates.get((TWINS.get(row["sequence"]), row["system"]))
        if twin and row.get("ate_rmse_m"):
            row["twin_ratio"] = round(row["ate_rmse_m"] / twin, 3)


def verdicts(rows: list[Row]) -> str:
    """Markdown table of all targets for which a row has a value."""
    lines = []
    for row in rows:
        for key, meaning, bound, direction in [*TARGETS.get(row["sequence"], []), *EVERYWHERE]:
            value = row.get(key)
            if value is None:
                continue
            reached = value <= bound if direction == "<=" else value >= bound
            figure = f"{value:.4g}"
            lines.append([row["sequence"], row["system"], meaning, f"{direction} {bound:g}", figure])
            lines[-1].append("yes" if reached else "NO")
    return grid(["sequence", "system", "what", "target", "measured", "reached"], lines, words=3)


def _announce(row: Row) -> None:
    print(row["sequence"], row["system"], row.get("error", "done"), flush=True)


def main() -> None:
    """Command line of the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--systems", default="dudmap", help="comma-separated; default: dudmap")
    parser.add_argument("--only", default="", help="comma-separated names of recordings")
    parser.add_argument("--out", type=Path, default=Path("runs/recordings"))
    parser.add_argument("--max-frames", type=int, default=None)
    parser.add_argument("--columns", choices=["color"], default=None, help="what colour brings")
    parser.add_argument("--set", action="append", default=[], help="key=value applied to every system")
    arguments = parser.parse_args()
    wanted = [name for name in arguments.only.split(",") if name]
    entries = [entry for entry in local_entries(arguments.data) if not wanted or entry.name in wanted]
    if arguments.max_frames:
        entries = [type(entry)(entry.name, entry.path, max_frames=arguments.max_frames) for entry in entries]
    if arguments.columns:
        rows = measure_columns(entries, Config().override(arguments.set), done=_announce)
        text = color_table(rows, COMPARED)
        save(rows, text, arguments.out, "color", {"machine": machine(), "versions": versions()})
        print(text)
        return
    jobs = [
        Job(entry, name, config.override(arguments.set), arguments.out / name / entry.name)
        for entry in entries
        for name, config in systems(arguments.systems).items()
    ]
    rows = measure_all(jobs, 1, _announce)
    with_twins(rows)
    columns = [*COLUMNS[:3], Column("twin_ratio", "x static twin", 1, 2), *COLUMNS[3:]]
    text = markdown(rows, columns) + "\nTargets:\n\n" + verdicts(rows)
    save(rows, text, arguments.out, "recordings", {"machine": machine(), "versions": versions()})
    print(text)


if __name__ == "__main__":
    main()
