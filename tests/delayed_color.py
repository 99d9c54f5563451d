"""A recording whose colour is taken after the depth, and a self-calibration that finds it out after a few frames."""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from dudmap.core.calibration import self_calibration
from dudmap.core.calibration.estimator import SHUTTER, TESTED, CalibrationEstimator, Estimate
from dudmap.core.verdict import Outcome, Verdict
from dudmap.lab.synthetic.faults import SensorFaults

DELAY = 0.03
"""Seconds."""
FAULTS = SensorFaults(color_delay=DELAY)


class KnownDelay(CalibrationEstimator):
    """Finds the true delay, which needs more and larger images than a quick test has; it has tests of its own."""

    def estimate(self, keyframes):
        found = replace(self.given, delay=DELAY, sigma=np.ones(13), estimated=("delay",))
        return Estimate(found, dict.fromkeys((*TESTED, SHUTTER), Verdict((Outcome("evidence", 4.0),))), 0.3, 80)


def find_early(monkeypatch, attempts):
    """Let the self-calibration estimate after these numbers of frames."""
    monkeypatch.setattr(self_calibration, "ATTEMPTS", attempts)
    monkeypatch.setattr(self_calibration, "USED_AFTER", 0)
    monkeypatch.setattr(self_calibration, "CalibrationEstimator", KnownDelay)
    monkeypatch.setattr(self_calibration, "estimate_beside", _estimated)


def _estimated(estimator, keyframes, **_) -> Future:
    """Result of an estimation in this process, where the class above is known."""
    future = Future()
    future.set_result(estimator.estimate(keyframes))
    return future
