"""A small study in a process of its own, which a test kills: python crash_study.py FOLDER RUNS real|fake."""

import sys
import time
from pathlib import Path

from dudmap.lab.study.conduct import conduct
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.worker import LocalExecutor


def sleep_row(run, out):
    time.sleep(0.05)
    return {"ate_rmse_m": run.values["tracker.huber"], "lost": 0}


def die_once(run, out):
    """End the process without a word at the first attempt of one run."""
    mark = Path(run.config.tracker.robust + "-died")  # in the current folder
    if run.point == 1 and not mark.exists():
        mark.touch()
        import os

        os._exit(3)
    return sleep_row(run, out)


def die_always(run, out):
    import os

    if run.point == 1:
        os._exit(3)
    return sleep_row(run, out)


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
    real = sys.argv[3] == "real"
    executor = LocalExecutor(2, threads=1, kernels=real)
    conduct(tiny_plan(int(sys.argv[2])).runs(), Path(sys.argv[1]), executor, do=None if real else sleep_row)
    executor.close()
