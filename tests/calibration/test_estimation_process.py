"""Estimation in a process of its own."""

import sys

import numpy as np
import pytest
from test_self_calibration import SMALL, observations

from dudmap.config import SensorConfig
from dudmap.core.calibration.estimation_process import CalibrationProcessWarning, estimate_beside
from dudmap.core.calibration.estimator import CalibrationEstimator
from dudmap.core.calibration.keyframes import KeyframeCollector
from dudmap.core.geometry.calibration import Calibration


@pytest.fixture(scope="module")
def problem():
    collector = KeyframeCollector(Calibration.registered(SMALL))
    collector._interval = 0.0
    for observation, T, mask in observations(20):
        collector.add(observation, T, mask)
    return CalibrationEstimator(Calibration.registered(SMALL), SensorConfig()), collector.keyframes


def same(one, other) -> bool:
    values = [np.array([*vars(each.calibration)["sigma"], each.gain, each.pairs]) for each in (one, other)]
    return np.array_equal(*values, equal_nan=True) and one.verdicts == other.verdicts


def test_the_result_is_that_of_this_process(problem):
    estimator, keyframes = problem
    assert same(estimate_beside(estimator, keyframes).result(120), estimator.estimate(keyframes))


def test_where_there_can_be_no_process_this_one_estimates_and_says_so(problem, monkeypatch):
    estimator, keyframes = problem
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.warns(CalibrationProcessWarning, match="frames are slower"):
        result = estimate_beside(estimator, keyframes).result(120)
    assert same(result, estimator.estimate(keyframes))


def test_an_error_is_raised_where_the_result_is_asked_for(problem):
    estimator, _ = problem
    with pytest.warns(CalibrationProcessWarning, match="exit status 1"), pytest.raises(AttributeError):
        estimate_beside(estimator, [None] * 40).result(120)
