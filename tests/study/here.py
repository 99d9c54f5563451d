"""Executor of the tests."""

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
