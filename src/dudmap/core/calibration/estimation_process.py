"""Estimation of a calibration in a process of its own while frames are tracked.

In a thread it would hold the interpreter for half of its time, and the frames would wait for it on both cores. Both
processes exchange objects as those of ``multiprocessing`` do, which would run the user's program again in the other.
"""

import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing.reduction import ForkingPickler
from threading import Thread

from dudmap.core.calibration.estimator import CalibrationEstimator, Estimate
from dudmap.core.calibration.keyframes import ColorKeyframe

received = ForkingPickler.loads  # pyright: ignore[reportAttributeAccessIssue] - typeshed leaves it out
"""Object that another process of ours sent."""
LOWEST = 19
"""Priority of the process, as of ``nice``, where there is no class of idle processes."""


class CalibrationProcessWarning(UserWarning):
    """The process of an estimation could not be used, and this one, whose frames then wait for it, estimates."""


def estimate_beside(estimator: CalibrationEstimator, keyframes: Sequence[ColorKeyframe]) -> "Future[Estimate]":
    """Result of ``estimator.estimate(keyframes)``, the same in either process."""
    future: Future[Estimate] = Future()

    def work() -> None:
        try:
            result, failure = _in_other_process(estimator, keyframes)
            if result is None:
                said = f"the calibration's own process cannot be used ({failure}); frames are slower meanwhile"
                warnings.warn(said, CalibrationProcessWarning, stacklevel=1)
                result = estimator.estimate(keyframes)
            future.set_result(result)
        except BaseException as error:  # raised where the result is asked for
            future.set_exception(error)

    Thread(target=work, name="dudmap-calibration", daemon=True).start()
    return future


def _in_other_process(
    estimator: CalibrationEstimator, keyframes: Sequence[ColorKeyframe]
) -> tuple[Estimate | None, str]:
    """The estimate, or None and why there is none."""
    environment = os.environ | {"DUDMAP_THREADS": "1"}
    command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, env=environment)
    except OSError as error:
        return None, str(error)
    assert process.stdin is not None
    with suppress(BrokenPipeError):  # it has ended, and says why; communicate() would write in small pieces
        process.stdin.write(ForkingPickler.dumps((estimator.given, estimator.sensor, list(keyframes))))
    answer, said = process.communicate()
    if process.returncode != 0:
        lines = said.decode(errors="replace").strip().splitlines()
        return None, f"exit status {process.returncode}{f': {lines[-1]}' if lines else ''}"
    return received(answer), ""


def main() -> None:
    """Write the estimate of what is read, both as ``_in_other_process`` does."""
    if sys.platform == "linux":  # it runs while no frame asks for its core, and leaves that at once
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif sys.platform != "win32":
        os.nice(LOWEST)
    given, sensor, keyframes = received(sys.stdin.buffer.read())
    sys.stdout.buffer.write(ForkingPickler.dumps(CalibrationEstimator(given, sensor).estimate(keyframes)))


if __name__ == "__main__":
    main()
