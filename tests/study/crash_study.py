"""A small study in a process of its own, which a test kills: python crash_study.py FOLDER RUNS."""

import os
import sys
import time
from pathlib import Path

from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.runs import conduct


def figures(job):
    """Figures of a run, and the process that made them in a file beside the study."""
    time.sleep(0.05)
    return {"ate_rmse_m": job.run.values["tracker.huber"], "lost": 0, "pid": os.getpid()}


def dies_once(job):
    """End the process without a word at the first attempt of one run."""
    mark = Path("died")  # in the current folder
    if job.run.point == 1 and not mark.exists():
        mark.touch()
        os._exit(3)
    return figures(job)


def dies_always(job):
    if job.run.point == 1:
        os._exit(3)
    return figures(job)


def tiny_plan(runs):
    levels = [round(0.005 + 0.001 * n, 4) for n in range(runs)]
    return make_plan(
        {
            "factors": {"tracker.huber": levels},
            "sequences": [{"scene": "room", "movers": [], "frames": 6, "camera": [160, 120]}],
            "responses": ["ate"],
        }
    )


if __name__ == "__main__":
    conduct(tiny_plan(int(sys.argv[2])).runs(), Path(sys.argv[1]), 2, measure=figures)
