"""Calibration while the camera moves: when a result is used, and what it changes in the map."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event, Timer

import cv2
import numpy as np
import pytest

from dudmap.config import Config, SensorConfig
from dudmap.core.calibration import self_calibration
from dudmap.core.calibration.estimator import SHUTTER, TESTED, Estimate
from dudmap.core.calibration.self_calibration import SelfCalibration
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.core.verdict import Outcome, Verdict
from dudmap.lab.synthetic import sequence
from dudmap.lab.synthetic.faults import SensorFaults

SMALL = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)
FRAMES, FIRST = 36, 12
UNREGISTERED = {"color_translation": (0.04, 0.0, 0.0), "color_focal_ratio": 0.92}


def recording(**faults):
    return sequence(
        movers=(), frames=FRAMES, camera=SMALL, noise="none", camera_path="fast", faults=SensorFaults(**faults), seed=3
    )


def truth_of(recorded) -> Calibration:
    faults = recorded.faults
    T = se3.inverse(faults.T_depth_color)
    names = ("translation_x", "log_focal")
    return Calibration(recorded.color_camera, T, faults.color_delay, faults.color_readout, np.ones(13), names)


class Estimator:
    """Knows the result, and gives it once it may."""

    def __init__(self, result: Calibration) -> None:
        self.result, self.may, self.keyframes = result, Event(), []

    def __call__(self, given, sensor):
        return self

    def estimate(self, keyframes):
        self.may.wait(20)
        self.keyframes.append(len(keyframes))
        return Estimate(self.result, dict.fromkeys((*TESTED, SHUTTER), Verdict((Outcome("evidence", 4.0),))), 0.3, 80)


@pytest.fixture
def estimator(monkeypatch):
    monkeypatch.setattr(self_calibration, "ATTEMPTS", (FIRST,))
    monkeypatch.setattr(self_calibration, "USED_AFTER", 0)
    made = Estimator(truth_of(recording(**UNREGISTERED)))
    monkeypatch.setattr(self_calibration, "CalibrationEstimator", made)
    with ThreadPoolExecutor(1) as beside:
        monkeypatch.setattr(
            self_calibration,
            "estimate_beside",
            lambda estimator, frames, idle: beside.submit(estimator.estimate, frames),
        )
        yield made
        made.may.set()


def observations(count: int):
    recorded, preprocess = recording(), Preprocessor(SMALL)
    for index in range(count):
        yield preprocess(recorded[index]), recorded.ground_truth.Ts_world_camera[index], np.zeros(SMALL.shape, bool)


def when_found(live: bool, estimator) -> int | None:
    """Frame with which a result is found; live it exists two frames after the estimation began."""
    if not live:
        estimator.may.set()
    calibrating = SelfCalibration(Calibration.registered(SMALL), SensorConfig(), live=live)
    for n, (observation, T, mask) in enumerate(observations(FIRST + 4), start=1):
        calibrating.add(observation, T, mask, 0)
        if live and n == FIRST + 2:
            estimator.may.set()
            assert calibrating._running is not None
            calibrating._running.result(20)
        if calibrating.found() is not None:
            assert calibrating.finished
            return n
    return None


def test_a_live_camera_uses_a_result_as_soon_as_it_exists_and_a_recording_always_at_the_same_frame(
    estimator, monkeypatch
):
    assert when_found(True, estimator) == FIRST + 2
    monkeypatch.setattr(self_calibration, "USED_AFTER", 3)
    assert when_found(False, estimator) == FIRST + 3
    assert estimator.keyframes[0] >= 2


def test_a_frame_waits_only_for_a_result_that_is_late(estimator, monkeypatch):
    monkeypatch.setattr(self_calibration, "USED_AFTER", 3)
    calibrating = SelfCalibration(Calibration.registered(SMALL), SensorConfig())
    found = []
    for observation, T, mask in observations(FIRST + 3):
        calibrating.add(observation, T, mask, 0)
        if calibrating._running is not None and calibrating._frames == FIRST + 3:
            Timer(0.2, estimator.may.set).start()
        found.append(calibrating.found() is not None)
    assert found == [False] * (FIRST + 2) + [True]
    assert calibrating.waits == 1


def test_what_is_as_given_changes_nothing(estimator):
    estimator.result = Calibration.registered(SMALL)
    assert when_found(False, estimator) is None


def test_poses_that_do_not_fit_those_before_are_not_compared_with_them(estimator):
    estimator.may.set()
    calibrating = SelfCalibration(Calibration.registered(SMALL), SensorConfig())
    for n, (observation, T, mask) in enumerate(observations(FIRST), start=1):
        calibrating.add(observation, T, mask, submap=0 if n < FIRST - 1 else 1)
    assert estimator.keyframes == [0]


def test_a_failed_estimation_is_not_hidden(estimator, monkeypatch):
    monkeypatch.setattr(estimator, "estimate", lambda keyframes: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        when_found(False, estimator)


def color_error(slam: Slam, exact, T_world_camera: np.ndarray) -> float:
    """Mean difference between the colours of the map, seen from where a frame was taken, and a faultless image."""
    seen = slam.volume.raycast(T_world_camera)
    inside = np.s_[10:-10, 10:-10]
    smooth = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)[inside] for image in (seen.color, exact.color)]
    return float(np.abs(smooth[0] - smooth[1])[seen.depth[inside] > 0].mean())


def test_the_map_is_repainted_with_the_calibration_that_was_found(estimator):
    """Also the frames that were made ready before it was known."""
    estimator.may.set()
    faulty, exact = recording(**UNREGISTERED), recording()
    config = Config().override(["loops.keep_gap=2", "volume.min_weight=1"])
    slam = Slam(SMALL, config)
    views = [slam.prepare(faulty[index]) for index in range(FRAMES)]
    results, before = [], np.nan
    for index in range(FRAMES):
        results.append(slam.process(views[index]))
        if index == FIRST - 1:
            before = color_error(slam, exact[8], slam.trajectory.Ts_world_camera[8])
    assert sum("calibrated" in result.events for result in results) == 1
    assert slam.calibration.tree() == estimator.result.tree()
    assert all(result.status == "tracked" for result in results)
    assert color_error(slam, exact[8], slam.trajectory.Ts_world_camera[8]) < 0.7 * before


def test_only_frames_since_it_is_known_that_stamps_are_late_have_poses_at_other_times_than_their_images(estimator):
    estimator.may.set()
    estimator.result = replace(Calibration.registered(SMALL), depth_late=0.02, estimated=("delay",))
    slam, frames = Slam(SMALL), recording()
    calibrated = ["calibrated" in slam.process(frames[index]).events for index in range(FRAMES)]
    assert any(calibrated[FIRST:])
    images, stamps = slam.image_poses.Ts_world_camera, slam.trajectory.Ts_world_camera
    assert (images != stamps).any(axis=(1, 2)).tolist() == [n > calibrated.index(True) for n in range(FRAMES)]


def test_a_known_calibration_or_the_configuration_leave_the_estimation_out(estimator):
    estimator.may.set()
    faulty = recording(**UNREGISTERED)
    for config, known in ((Config(), truth_of(faulty)), (Config().override(["sensor.self_calibration=false"]), None)):
        slam = Slam(SMALL, config, calibration=known)
        assert not any("calibrated" in slam.process(faulty[index]).events for index in range(FIRST))
    assert estimator.keyframes == []
