"""Ablation: the default configuration with one part disabled at a time.

    python benchmarks/ablation.py [--data FOLDER] [--only NAME,NAME] [--out DIR]

Uses five synthetic recordings and, with --data, every recording in a folder. Prints ATE, lost frames and mask IoU per
part and writes ablation.md, .csv and .json.
"""

import argparse
from pathlib import Path

from dudmap.app.pipeline.environment import machine, versions
from dudmap.config import Config
from dudmap.lab.benchmark.entries import Entry, local_entries
from dudmap.lab.benchmark.measure import Job, Row, measure_all
from dudmap.lab.benchmark.table import grid, save

PARTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "two-passes": (),
    "no start (parallax)": ("dynamics.start_seconds=0",),
    "no free space": ("dynamics.free_space=false",),
    "no regions": ("dynamics.regions=false",),
    "no pieces": ("dynamics.pieces=false",),
    "no second registration": ("tracker.second_pass=false",),
    "no carving": ("volume.carving=false",),
    "no limit of poor readings": ("volume.max_readings=255",),
    "no colour": ("tracker.color_weight=0",),
    "no exposure fit": ("tracker.exposure=false",),
    "no noise weighting": ("tracker.noise_weighting=false",),
    "no relocalisation": ("relocalization.enabled=false",),
    "no dynamics": ("dynamics.method=none",),
}
"""Names and differences from the default configuration; for ``two-passes`` see ``lab/benchmark/systems.py``."""
SMALL = (320, 240)
WORLDS = (
    Entry("two people", parameters={"movers": ("people",), "frames": 90, "camera": SMALL}),
    Entry("crowd from the start", parameters={"coverage": 0.4, "start_dynamic": True, "frames": 90, "camera": SMALL}),
    Entry("slow creeper", parameters={"movers": ("creeper",), "frames": 90, "camera": SMALL}),
    Entry("an object starts to move", parameters={"situation": "starts", "frames": 90, "camera": SMALL}),
    Entry("kidnapped", parameters={"situation": "kidnapped", "frames": 90, "camera": SMALL}),
)


def cell(row: Row) -> str:
    """ATE in cm, number of lost frames and mask IoU of one run."""
    if "error" in row:
        return "failed"
    ate = row.get("ate_rmse_m")
    drift = row.get("drift_rmse_m")
    text = f"{100 * ate:.2f}" if ate is not None else f"{100 * drift:.2f}*" if drift is not None else "-"
    text += f" ({row['lost']} lost)" if row.get("lost") else ""
    return text + (f" / {row['mask_iou_mean']:.2f}" if row.get("mask_iou_mean") is not None else "")


def main() -> None:
    """Command line of the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=None, help="folder of recordings")
    parser.add_argument("--only", default="", help="comma-separated names of worlds and recordings")
    parser.add_argument("--out", type=Path, default=Path("runs/ablation"))
    arguments = parser.parse_args()
    wanted = [name for name in arguments.only.split(",") if name]
    entries = [*WORLDS, *(local_entries(arguments.data) if arguments.data else [])]
    entries = [entry for entry in entries if not wanted or entry.name in wanted]
    jobs = [
        Job(entry, name, Config().override(list(assignments)))
        for entry in entries
        for name, assignments in PARTS.items()
    ]
    rows = measure_all(jobs, 1, lambda row: print(row["sequence"], row["system"], row.get("error", "done"), flush=True))
    by_cell = {(row["system"], row["sequence"]): row for row in rows}
    names = [entry.name for entry in entries]
    lines = [[part, *(cell(by_cell[part, name]) for name in names)] for part in PARTS]
    text = "ATE RMSE in cm (lost frames) / mean mask IoU; * drift RMSE in cm, first poses aligned.\n\n"
    text += grid(["part", *names], lines, words=1)
    save(rows, text, arguments.out, "ablation", {"machine": machine(), "versions": versions()})
    print(text)


if __name__ == "__main__":
    main()
