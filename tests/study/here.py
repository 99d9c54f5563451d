"""Runs of a study in the process of the tests."""

import json
from pathlib import Path

from dudmap.lab.study.runs import Job, measure_run


class Here:
    """Does runs in this process with a given function of a run, or with the system, each once."""

    def __init__(self, figures=None):
        self.figures = figures or (lambda run: measure_run(Job(run, 1, None)))
        self.runs, self.rows = [], {}

    def __call__(self, runs):
        for run in runs:
            if run.key not in self.rows:
                self.runs.append(run)
                self.rows[run.key] = self.figures(run)
        return [self.rows[run.key] for run in runs]


def kept(folder):
    """Keys of the runs whose figures lie in a study folder."""
    file = Path(folder) / "runs.jsonl"
    lines = file.read_text().splitlines() if file.is_file() else []
    return [json.loads(line)["label"]["run"] for line in lines if line.endswith("}")]
