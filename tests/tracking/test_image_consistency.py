"""The comparison of a registered frame with the last one: right poses, wrong poses, and what cannot be told."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap import Config, Slam, synthetic
from dudmap.geometry import se3
from dudmap.geometry.camera import Camera
from dudmap.tracking.estimate import PoseEstimate
from dudmap.tracking.image_consistency import MAX_MISREGISTRATION, ImageConsistency
from dudmap.tracking.motion_model import MotionModel

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)


@pytest.fixture(scope="module")
def pair():
    """Two frames of a moving camera, and the pose of the second in the frame of the first."""
    sequence = synthetic.sequence("room", movers=(), frames=12, camera=CAMERA, seed=2)
    slam = Slam(CAMERA)
    truth = sequence.ground_truth.Ts_world_camera
    return slam.prepare(sequence[8]), slam.prepare(sequence[11]), se3.inverse(truth[8]) @ truth[11]


def at(T):
    start = PoseEstimate.at_origin()
    return replace(start, tracking=replace(start.tracking, T_world_camera=T))


def beside(x):
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


def consistency(view, **config):
    config = Config().override([f"{key.replace('__', '.')}={value}" for key, value in config.items()])
    images = ImageConsistency(config, MotionModel(config.tracker))
    images.update(view, PoseEstimate.at_origin())
    return images


def test_a_wrong_pose_shows_in_the_last_image(pair):
    first, second, right = pair
    images = consistency(first)
    distances = [images.misregistration(second, at(right), right @ beside(x)) for x in (0, 0.03, 0.15)]
    assert distances[0] < 0.6 * MAX_MISREGISTRATION
    assert distances == sorted(distances)
    assert distances[2] > MAX_MISREGISTRATION


def test_gain_and_offset_are_no_misregistration(pair):
    first, second, right = pair
    images = consistency(first)
    coarse = second.pyramid.coarse
    lit = replace(coarse, intensity=(0.8 * coarse.intensity + 0.05).astype(np.float32))
    pyramid = replace(second.pyramid, tracked=[lit, *second.pyramid.tracked[1:]])
    assert images.misregistration(replace(second, pyramid=pyramid), at(right), right) < 0.6 * MAX_MISREGISTRATION


def test_a_pose_is_contradicted_unless_the_corners_support_it(pair):
    first, second, right = pair
    images, wrong = consistency(first), right @ beside(0.15)
    assert images.contradicts(second, at(right), lambda: None) == ""
    assert "no motion joins them" in images.contradicts(second, at(wrong), lambda: None)
    assert "at the motion seen" in images.contradicts(second, at(wrong), lambda: right)
    assert images.contradicts(second, at(wrong), lambda: wrong) == ""


def test_without_a_last_image_nothing_is_contradicted(pair):
    first, second, right = pair
    wrong = at(right @ beside(0.15))
    images = consistency(first)
    assert images.contradicts(replace(second, blind=True), wrong, lambda: None) == ""
    images.update(replace(first, blind=True), PoseEstimate.at_origin())
    assert images.contradicts(second, wrong, lambda: None) == ""
    images = consistency(first)
    images.reset()
    assert np.isnan(images.misregistration(second, wrong, right))
    assert consistency(first, dynamics__start_seconds=0).contradicts(second, wrong, lambda: None) == ""


def test_dynamic_pixels_do_not_count(pair):
    first, second, right = pair
    images = consistency(first)
    labels = type("Labels", (), {"dynamic": np.ones(second.labelled.depth.shape, bool)})()
    assert np.isnan(images.misregistration(second, replace(at(right), labels=labels), right))
