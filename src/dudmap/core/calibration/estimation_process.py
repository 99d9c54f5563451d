"""Estimation of a calibration in a separate process, because a thread would hold the interpreter lock.

``multiprocessing`` itself would run the user's main module again.
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
"""Unpickles an object from another process of this program."""
LOWEST, LOWER = 19, 5
"""Priority of an idle process (``nice``) on systems without such processes; difference of another one to this process:
a third of a core that a frame needs at the same time."""


class CalibrationProcessWarning(UserWarning):
    """The separate process failed; the estimation in this process delays the frames."""


def estimate_beside(
    estimator: CalibrationEstimator, keyframes: Sequence[ColorKeyframe], *, idle: bool = False
) -> "Future[Estimate]":
    """Future of ``estimator.estimate(keyframes)``, computed in a separate process, or in a thread if that fails.

    With ``idle`` the process runs only while nothing else needs its core, and possibly never ends.
    """
    future: Future[Estimate] = Future()

    def work() -> None:
        try:
            result, failure = _in_other_process(estimator, keyframes, idle=idle)
            if result is None:
                said = f"the calibration's own process cannot be used ({failure}); frames are slower meanwhile"
                warnings.warn(said, CalibrationProcessWarning, stacklevel=1)
                result = estimator.estimate(keyframes)
            future.set_result(result)
        except BaseException as error:  # raised by ``Future.result``
            future.set_exception(error)

    Thread(target=work, name="dudmap-calibration", daemon=True).start()
    return future


def _in_other_process(
    estimator: CalibrationEstimator, keyframes: Sequence[ColorKeyframe], *, idle: bool
) -> tuple[Estimate | None, str]:
    environment = os.environ | {"DUDMAP_THREADS": "1"}
    command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, env=environment)
        if idle and sys.platform == "linux":
            os.sched_setscheduler(process.pid, os.SCHED_IDLE, os.sched_param(0))
        elif sys.platform != "win32":
            nice = LOWEST if idle else min(os.getpriority(os.PRIO_PROCESS, 0) + LOWER, LOWEST)
            os.setpriority(os.PRIO_PROCESS, process.pid, nice)
    except OSError as error:
        return None, str(error)
    assert process.stdin is not None
    with suppress(BrokenPipeError):  # the process has ended; communicate() would write in small pieces
        process.stdin.write(ForkingPickler.dumps((estimator.given, estimator.sensor, list(keyframes))))
    answer, said = process.communicate()
    if process.returncode != 0:
        lines = said.decode(errors="replace").strip().splitlines()
        return None, f"exit status {process.returncode}{f': {lines[-1]}' if lines else ''}"
    return received(answer), ""


def main() -> None:
    """Write the estimate for the pickled input of ``_in_other_process`` to stdout."""
    given, sensor, keyframes = received(sys.stdin.buffer.read())
    sys.stdout.buffer.write(ForkingPickler.dumps(CalibrationEstimator(given, sensor).estimate(keyframes)))


if __name__ == "__main__":
    main()
