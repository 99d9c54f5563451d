"""Registration of the colours with the camera's motion, in the whole system."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dudmap.config import Config, TrackerConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.core.tracking.color_motion import ColorMotion
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.lab.synthetic import sequence
from dudmap.lab.synthetic.faults import SensorFaults

SMALL = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)
FRAMES = 12


def recording(**faults):
    return sequence(
        movers=(), frames=FRAMES, camera=SMALL, noise="none", camera_path="fast", faults=SensorFaults(**faults), seed=3
    )


def smooth(image: np.ndarray) -> np.ndarray:
    """Without the detail of single pixels, which interpolation changes."""
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)


def truth_of(recording) -> Calibration:
    faults = recording.faults
    T = se3.inverse(faults.T_depth_color)
    return Calibration(recording.color_camera, T, faults.color_delay, faults.color_readout)


def poses(recording, calibration, *, ahead: bool = False) -> np.ndarray:
    slam = Slam(recording.camera, calibration=calibration)
    frames = [recording[index] for index in range(FRAMES)]
    given = [slam.prepare(frame) for frame in frames] if ahead else frames
    return np.array([slam.process(frame).T_world_camera for frame in given])


@pytest.mark.parametrize(
    "faults",
    [
        {"color_delay": 0.03},
        {"color_readout": -0.03},
        {"color_translation": (0.03, 0.0, 0.0), "color_focal_ratio": 0.9, "color_delay": -0.02},
    ],
)
def test_colours_are_those_of_a_camera_that_sees_at_the_time_and_place_of_the_depth(faults):
    """Registered with the true calibration and the true motion, against a rendering without faults."""
    faulty, exact = recording(**faults), recording()
    Ts, truth = exact.ground_truth.Ts_world_camera, truth_of(faulty)
    slam = Slam(SMALL, calibration=truth)
    before, after = [], []
    for n in range(1, 10):
        other = n + 1 if truth.delay >= 0 else n - 1  # the colours are taken on the way to this frame
        motion = MotionModel(TrackerConfig())
        motion.update(0.0, Ts[min(n, other)])
        velocity = motion.velocity_to(1 / 30, Ts[max(n, other)])
        motion.restart(0.0, Ts[n])
        view = replace(slam.prepare(faulty[n]), color_velocity=velocity)
        # a pose that says the same velocity again
        view = ColorMotion(motion, truth).registered(
            replace(view, observation=replace(view.observation, timestamp=1 / 30)), Ts[n] @ se3.exp(velocity / 30)
        )
        inside = np.s_[10:-10, 10:-10]
        sharp = smooth(exact[n].color)[inside]
        before.append(np.abs(smooth(faulty[n].color)[inside] - sharp).mean())
        after.append(np.abs(smooth(view.colored().rgb)[inside] - sharp).mean())
    assert np.mean(after) < 0.6 * np.mean(before)


def test_a_first_frame_takes_its_colours_from_the_velocity_of_the_second():
    faulty, exact = recording(color_delay=0.03), recording()
    slam = Slam(SMALL, Config().override(["volume.min_weight=1"]), calibration=truth_of(faulty))
    inside, errors = np.s_[10:-10, 10:-10], []
    for n in (0, 1):
        slam.process(faulty[n])
        seen = slam.volume.raycast(np.eye(4))
        known = seen.depth[inside] > 0
        difference = np.abs(smooth(seen.color)[inside] - smooth(exact[0].color)[inside])
        errors.append(difference[known].mean())
    assert errors[1] < errors[0]


def test_the_second_frame_is_remembered_with_the_colours_of_its_velocity():
    """The third one, whose colours are registered, is compared with it."""
    faulty, exact = recording(color_delay=0.03), recording()
    slam, plain = (Slam(SMALL, calibration=given) for given in (truth_of(faulty), None))
    for n in (0, 1):
        slam.process(faulty[n])
    inside, sharp = np.s_[10:-10, 10:-10], smooth(plain.prepare(exact[1]).pyramid.fine.intensity)
    remembered, recorded = slam.predictor.image_motion.last.pyramid, plain.prepare(faulty[1]).pyramid
    after, before = (np.abs(smooth(images.fine.intensity) - sharp)[inside].mean() for images in (remembered, recorded))
    assert after < 0.7 * before


def test_frames_that_are_prepared_ahead_give_the_same_result():
    faulty = recording(color_delay=0.02, color_translation=(0.02, 0.0, 0.0))
    calibration = truth_of(faulty)
    assert np.array_equal(poses(faulty, calibration), poses(faulty, calibration, ahead=True))


def test_registered_colour_is_taken_as_it_is_bit_for_bit():
    exact = recording()
    same = replace(Calibration.registered(SMALL), sigma=np.ones(13))
    assert np.array_equal(poses(exact, None), poses(exact, same))


@pytest.mark.parametrize("setting", ["dynamics.enabled=true", "dynamics.enabled=false"])
def test_the_frame_that_is_fused_is_the_one_that_was_registered(setting):
    faulty = recording(color_delay=0.03)
    slam, made, given = Slam(SMALL, Config().override([setting]), calibration=truth_of(faulty)), [], []
    refined, registered = slam.color_motion.refined, slam.color_motion.registered
    slam.color_motion.refined = lambda view, T: made.append(refined(view, T)) or made[-1]
    slam.color_motion.registered = lambda view, T: given.append(view) or registered(view, T)
    for index in range(5):
        slam.process(faulty[index])
    assert given[-1] is made[-1]
    assert np.linalg.norm(made[-1].color_velocity) > 0
