"""Runs on a Ray cluster (extra ``cluster``)."""

from importlib import import_module
from typing import Any

from dudmap.errors import ConfigError
from dudmap.extras import extra, install
from dudmap.lab.study.worker import Job, Outcome, perform, set_threads


class RayExecutor:
    """Tasks of a Ray cluster. All nodes must see the study folder, and recordings without URL, under the same paths.

    The address is ``auto`` or ``ray://HOST:PORT``; without a number of workers they take all cores of the cluster.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: There is no cluster at the address.
    """

    def __init__(self, address: str, workers: int | None = None) -> None:
        with extra("cluster", "--cluster"):
            ray: Any = import_module("ray")
        try:
            ray.init(address, ignore_reinit_error=True, log_to_driver=False, logging_level="error")
        except (ConnectionError, ValueError) as error:
            raise ConfigError(f"there is no Ray cluster at {address}: {error}") from None
        except ImportError as error:  # ray:// needs the client of Ray
            raise ConfigError(f"ray lacks its client ({error}); {install('cluster')}") from None
        self._ray = ray
        self._perform: Any = ray.remote(num_cpus=1, max_retries=0)(_perform)  # dudmap's conduct tries again
        self.workers = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self.cores = 1  # that a run reserves, and its number of threads
        self._running: set[Any] = set()

    def perform(self, job: Job) -> Outcome:
        """See ``Executor``."""
        errors, reference = self._ray.exceptions, self._perform.remote(job)
        self._running.add(reference)
        try:
            return self._ray.get(reference)
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError):
            return "died"
        finally:
            self._running.discard(reference)

    def close(self) -> None:
        """See ``Executor``. The cluster goes on; its runs of this study are ended."""
        for reference in list(self._running):
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()


def _perform(job: Job) -> Outcome:
    set_threads(1)
    return perform(job)
