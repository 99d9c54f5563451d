"""Tables of docs/sensitivity.md from the runs of benchmarks/designs/thesis81.toml.

``python benchmarks/sensitivity_tables.py runs/study/thesis81/runs.csv``
"""

import sys

import numpy as np
import pandas as pd

from dudmap.lab.benchmark.table import grid
from dudmap.lab.study.report import shown
from dudmap.lab.study.thesis import DAMPING, HUBER, VOXEL, WEIGHT

CHOSEN = {HUBER: 0.01, DAMPING: 0.02, VOXEL: 0.01, WEIGHT: 0.1}
"""Best point of table 6.1 of the thesis."""


def show(frame: pd.DataFrame) -> None:
    """Print a table as Markdown."""
    print(grid([*frame.columns], [[shown(value) for value in row] for row in frame.itertuples(index=False)], 1))


def main(path: str) -> None:
    """Print all tables."""
    runs = pd.read_csv(path)
    runs["mm"], runs["whole"] = 1000 * runs["ate_rmse_m"], runs["lost"] == 0
    groups = runs.groupby("sequence", sort=False)
    whole = runs[runs["whole"]].copy()
    print("Runs that track every frame, and their ATE, mm:\n")
    table = groups.agg(frames=("frames", "max"), runs=("whole", "size"), whole=("whole", "sum"))
    of_whole = whole.groupby("sequence", sort=False)["mm"]
    table = table.assign(least=of_whole.min(), median=of_whole.median(), largest=of_whole.max())
    chosen = whole[(whole[list(CHOSEN)] == pd.Series(CHOSEN)).all(axis=1)].set_index("sequence")
    table["thesis' best point"] = chosen["mm"]
    table["its rank"] = [
        int((group["mm"] < chosen["mm"][name]).sum() + 1) for name, group in whole.groupby("sequence", sort=False)
    ]
    show(table.reset_index(names="recording"))
    print("\nLevels: ATE of runs that track every frame relative to the mean of their recording (geometric), share of "
          "runs that lose frames, processor time relative to the first level:\n")  # fmt: skip
    log = np.log(whole["mm"])
    whole["relative"] = log - log.groupby(whole["sequence"]).transform("mean")
    cpu = np.log(runs["cpu_s"])
    runs["cpu"] = cpu - cpu.groupby(runs["sequence"]).transform("mean")
    rows = []
    for factor in CHOSEN:
        relative, times = np.exp(whole.groupby(factor)["relative"].mean()), np.exp(runs.groupby(factor)["cpu"].mean())
        lose = 1 - runs.groupby(factor)["whole"].mean()
        for level in relative.index:
            rows.append((factor, level, relative[level], f"{lose[level]:.0%}", times[level] / times.iloc[0]))
    show(pd.DataFrame(rows, columns=["factor", "level", "ATE", "lose frames", "time"]))
    print("\nMedian ATE of all runs, mm, by level:\n")
    parts = []
    for factor in CHOSEN:
        parts.append(runs.pivot_table(index="sequence", columns=factor, values="mm", aggfunc="median", sort=False))
        parts[-1].columns = [f"{factor.rpartition('.')[2]} {level:g}" for level in parts[-1].columns]
    show(pd.concat(parts, axis=1).reset_index(names="recording"))


if __name__ == "__main__":
    main(sys.argv[1])
