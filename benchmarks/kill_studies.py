"""Kill trials: studies of short synthetic runs are killed at random moments, go on, and lost and doubled runs counted.

``python benchmarks/kill_studies.py processes`` kills, in turn, the study itself and one of its workers.
``python benchmarks/kill_studies.py ray`` kills, in turn, the study, a worker, and a node of a local Ray cluster of two
nodes (``ray.cluster_utils``).

Everything is killed by SIGKILL. A trial passes if, after the same command was given again where the study had ended,
every run has one result, no run was finished twice or begun again after it was finished, and every figure is that of a
study that nobody disturbed. The result is one line per trial and a summary (docs/cluster.md).
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from dudmap.lab.study.conduct import conduct
from dudmap.lab.study.plan import Plan, make_plan
from dudmap.lab.study.store import StudyFolder

RUNS = 8
"""Runs of a study."""
LIMIT = 400.0
"""Longest time of a trial, seconds; one that takes longer has failed."""
VICTIMS = {"processes": ("study", "worker"), "ray": ("study", "worker", "node")}
"""What is killed, in turn."""


def plan() -> Plan:
    """A study of ``RUNS`` real runs of half a second each."""
    levels = [round(0.005 + 0.002 * n, 4) for n in range(RUNS)]
    room = {"scene": "room", "movers": ["person"], "start_dynamic": True, "frames": 6, "camera": [160, 120]}
    return make_plan({"factors": {"tracker.huber": levels}, "sequences": [room], "responses": ["ate"]})


def work(folder: Path, address: str) -> None:
    """Do the study, or what is left of it."""
    from dudmap.lab.study.executor import Executor, LocalExecutor

    executor: Executor
    if address:
        from dudmap.lab.study.cluster import RayExecutor

        executor = RayExecutor(address)
    else:
        executor = LocalExecutor(2, threads=1, kernels=False)
    conduct(plan().runs(), folder, executor)
    executor.close()


def start(folder: Path, address: str) -> "subprocess.Popen[bytes]":
    """A study in a process of its own."""
    return subprocess.Popen([sys.executable, __file__, "work", "--folder", str(folder), "--address", address],
                            stderr=subprocess.DEVNULL, start_new_session=True)  # fmt: skip


def busy_worker(store: StudyFolder) -> int | None:
    """Process that is doing a run, None if there is none."""
    open_runs: dict[str, int] = {}
    for line in store.journal():
        if line["event"] == "begun":
            open_runs[line["run"]] = line["pid"]
        else:
            open_runs.pop(line["run"], None)
    return next(iter(open_runs.values()), None)


def kill(victim: str, process: "subprocess.Popen[bytes]", store: StudyFolder, nodes: "Nodes | None") -> bool:
    """Kill something; whether there was something to kill."""
    if victim == "node":
        assert nodes is not None
        nodes.lose_one()
        return True
    pid = process.pid if victim == "study" else busy_worker(store)
    if pid is None or process.poll() is not None:
        return False
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


class Nodes:
    """Local Ray cluster of two nodes with one core each, one of which can be lost and replaced."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        self._cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        self._other = self._cluster.add_node(num_cpus=1)
        self.address: str = self._cluster.address

    def lose_one(self) -> None:
        """End the second node at once."""
        self._cluster.remove_node(self._other, allow_graceful=False)
        self._other = None

    def replace(self) -> None:
        """Have two nodes again."""
        if self._other is None:
            self._other = self._cluster.add_node(num_cpus=1)

    def close(self) -> None:
        """End the cluster."""
        self._cluster.shutdown()


def trial(folder: Path, victim: str, rng: random.Random, nodes: Nodes | None, truth: dict[str, Any]) -> dict[str, int]:
    """One study that is killed once, and what came of it."""
    store, address = StudyFolder(folder), nodes.address if nodes else ""
    begin, killed, starts = time.monotonic(), False, 1
    process, moment = start(folder, address), rng.randrange(RUNS - 1)
    while process.poll() is None and not killed and time.monotonic() - begin < LIMIT:
        events = Counter(line["event"] for line in store.journal())
        if events["begun"] > moment:
            time.sleep(rng.uniform(0, 0.5))
            killed = kill(victim, process, store, nodes)
        time.sleep(0.01)
    while time.monotonic() - begin < LIMIT:
        try:
            if process.wait(timeout=LIMIT) == 0:
                break
        except subprocess.TimeoutExpired:
            break
        process, starts = start(folder, address), starts + 1
    process.kill()
    rows = {run.key: (store.result(run.key) or {"row": {}})["row"] for run in plan().runs()}
    events = [(line["event"], line["run"]) for line in store.journal()]
    finished = Counter(run for event, run in events if event == "finished")
    first = {run: events.index(("finished", run)) for run in finished}
    again = sum(event == "begun" and n > first.get(run, len(events)) for n, (event, run) in enumerate(events))
    return {
        "killed": int(killed),
        "starts": starts,
        "lost": sum(not row for row in rows.values()),
        "doubled": sum(count > 1 for count in finished.values()) + again,
        "different": sum(bool(row) and row.get("ate_rmse_m") != truth[key] for key, row in rows.items()),
        "repeated": sum(event == "begun" for event, _ in events) - RUNS,
        "seconds": round(time.monotonic() - begin),
    }


def main(engine: str, trials: int, seed: int) -> bool:
    """All trials; whether every one passed."""
    rng, failed, kills = random.Random(seed), 0, Counter[str]()
    with tempfile.TemporaryDirectory(prefix="kill-trials-") as root:
        calm = Path(root) / "undisturbed"
        if start(calm, "").wait() != 0:
            raise SystemExit("the undisturbed study failed")
        truth = {
            run.key: (StudyFolder(calm).result(run.key) or {"row": {}})["row"]["ate_rmse_m"] for run in plan().runs()
        }
        nodes = Nodes() if engine == "ray" else None
        try:
            for number in range(trials):
                victim = VICTIMS[engine][number % len(VICTIMS[engine])]
                if nodes:
                    nodes.replace()
                found = trial(Path(root) / str(number), victim, rng, nodes, truth)
                good = found["killed"] and not (found["lost"] or found["doubled"] or found["different"])
                failed += not good
                kills[victim] += found["killed"]
                print(f"{engine} {number + 1}: {victim}, {found}, {'passed' if good else 'FAILED'}", flush=True)
        finally:
            if nodes:
                nodes.close()
    print(f"{engine}: {trials - failed} of {trials} passed; killed: {dict(kills)}; seed {seed}")
    return not failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("engine", choices=("processes", "ray", "work"))
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="used by the trials themselves")
    parser.add_argument("--address", default="", help="used by the trials themselves")
    given = parser.parse_args()
    if given.engine == "work":
        work(given.folder, given.address)
    elif not main(given.engine, given.trials, given.seed):
        raise SystemExit(1)
