"""Executor of the tests, and what a study folder says of its runs."""

import json
from pathlib import Path

from dudmap.lab.study.worker import perform


class Here:
    """Executor that does jobs in this process with a given function, or with the system."""

    workers, cores = 1, 1

    def __init__(self, do=None):
        self.do, self.runs = do, []

    def perform(self, job):
        self.runs.append(job.run)
        return perform(job._replace(do=self.do))

    def close(self):
        pass


def journal(folder):
    """All lines of the journals of a study folder in the order of time."""
    lines = [line for path in Path(folder).glob("journal*.jsonl") for line in path.read_text().splitlines()]
    return sorted((json.loads(line) for line in lines if line.endswith("}")), key=lambda line: line["time"])
