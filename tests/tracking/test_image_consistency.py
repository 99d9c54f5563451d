"""The comparison of a registered frame with the last one: right poses, wrong poses, and what cannot be told."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking.checks import MAX_IMAGE_SHIFT
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.quality_monitor import ImageComparison, ImageConsistency
from dudmap.lab import synthetic

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


@pytest.fixture
def images():
    return ImageConsistency(Config(), MotionModel(Config().tracker))


def tracked(view, **attributes):
    """The first frame as it is remembered."""
    return view.tracked_at(np.eye(4), **attributes)


def is_supported(images, first, view, estimate, image_pose=lambda *_: None):
    last = tracked(first)
    return images.supported(last, view, estimate, images.compare(last, view, estimate), image_pose)


def test_a_wrong_pose_shows_in_the_last_image(pair, images):
    first, second, right = pair
    shifts = [images.compare(tracked(first), second, at(right @ beside(x))).shift for x in (0, 0.03, 0.15)]
    assert shifts[0] < 0.6 * MAX_IMAGE_SHIFT
    assert shifts == sorted(shifts)
    assert shifts[2] > MAX_IMAGE_SHIFT


def test_the_depth_of_the_last_frame_confirms_the_right_pose_alone(pair, images):
    first, second, right = pair
    assert images.compare(tracked(first), second, at(right)).confirms
    assert images.compare(tracked(first), second, at(right)).share_of_seen > 0.95
    for turn in (20.0, -20.0):
        wrong = right @ se3.exp(np.array([0, 0, 0.2, 0, np.radians(turn), 0]))
        assert not images.compare(tracked(first), second, at(wrong)).confirms


def test_gain_and_offset_are_no_misregistration(pair, images):
    first, second, right = pair
    coarse = second.pyramid.coarse
    lit = replace(coarse, intensity=(0.8 * coarse.intensity + 0.05).astype(np.float32))
    pyramid = replace(second.pyramid, tracked=[lit, *second.pyramid.tracked[1:]])
    changed = replace(second, levels=lambda: pyramid)
    assert images.compare(tracked(first), changed, at(right)).shift < 0.6 * MAX_IMAGE_SHIFT


def test_a_pose_is_contradicted_unless_the_corners_support_it(pair, images):
    first, second, right = pair
    wrong = right @ beside(0.15)
    assert is_supported(images, first, second, at(right))
    assert not is_supported(images, first, second, at(wrong))
    assert not is_supported(images, first, second, at(wrong), lambda *_: right)
    assert is_supported(images, first, second, at(wrong), lambda *_: wrong)


def test_colours_of_another_time_do_not_contradict_the_depth(pair, images, monkeypatch):
    """At the motion of the corners the images fit better: it contradicts the pose unless the depths deny it."""
    first, second, right = pair
    elsewhere = right @ beside(0.15)
    seen = ImageComparison(2 * MAX_IMAGE_SHIFT, 0.85, 0.95)
    for other, supported in ((ImageComparison(0.6, 0.8, 0.95), False), (ImageComparison(0.6, 0.3, 0.35), True)):
        monkeypatch.setattr(images, "compare", lambda last, view, estimate, T, other=other: other)
        assert images.supported(tracked(first), second, at(right), seen, lambda *_: elsewhere) is supported
    doubtful = replace(seen, share_of_seen=0.6)
    assert not images.supported(tracked(first), second, at(right), doubtful, lambda *_: elsewhere)


def test_without_a_last_image_nothing_is_contradicted(pair, images):
    first, second, right = pair
    wrong = at(right @ beside(0.15))
    assert is_supported(images, first, replace(second, blind=True), wrong)
    blind = tracked(first, blind=True)
    seen = images.compare(blind, second, at(right))
    assert images.supported(blind, second, wrong, images.compare(blind, second, wrong), lambda *_: None)
    assert np.isnan(seen.shift)
    assert seen.confirms  # the depth of a frame without texture still counts
    assert np.isnan(images.compare(None, second, wrong).shift)
    assert images.supported(None, second, wrong, ImageComparison(), lambda *_: None)


def test_dynamic_pixels_do_not_count(pair, images):
    first, second, right = pair
    labels = type("Labels", (), {"dynamic": np.ones(second.labelled.depth.shape, bool)})()
    assert np.isnan(images.compare(tracked(first), second, replace(at(right), labels=labels)).shift)
    last = tracked(first, moving=labels.dynamic)  # nor do those of the last frame
    assert np.isnan(images.compare(last, second, at(right)).shift)
