"""A study on a Ray cluster of two nodes, one of which is killed in the middle."""

import os
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

ray = pytest.importorskip("ray")

from dudmap.errors import ConfigError
from dudmap.lab.study.conduct import conduct
from study.crash_study import sleep_row, tiny_plan
from study.here import journal

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def slower_row(run, out):
    time.sleep(0.5)
    return sleep_row(run, out)


def test_no_cluster_is_one_sentence():
    from dudmap.lab.study.cluster import RayExecutor

    with pytest.raises(ConfigError, match="no Ray cluster at auto"):
        RayExecutor("auto")


def test_a_lost_node_loses_no_run(tmp_path, monkeypatch):
    from ray.cluster_utils import Cluster

    from dudmap.lab.study.cluster import RayExecutor

    where = os.pathsep.join([*sys.path, str(Path(__file__).parents[1])])
    monkeypatch.setenv("PYTHONPATH", where)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    other = cluster.add_node(num_cpus=1)
    executor = RayExecutor(cluster.address)
    assert executor.workers == 2
    killed = []

    def kill_once(progress):
        if progress.done >= 6 and not killed:
            killed.append(progress.done)
            cluster.remove_node(other, allow_graceful=False)

    runs = tiny_plan(20).runs()
    try:
        state = conduct(runs, tmp_path, executor, do=slower_row, report=kill_once)
    finally:
        executor.close()
        cluster.shutdown()
    assert killed
    assert state.done == 20
    events = Counter(line["event"] for line in journal(tmp_path))
    assert events["finished"] == 20
    assert 20 <= events["begun"] <= 21
    assert state.deaths <= 2
