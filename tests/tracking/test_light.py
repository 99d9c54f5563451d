"""Light that changes: exposure, comparison of images, poses, and colours of the map."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap import Config, Slam
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.frames.observation import exposed_color
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.tracking.checks import MAX_IMAGE_SHIFT
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.quality_monitor import ImageConsistency
from dudmap.lab import synthetic

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
DARK_FROM, DARK_TO = 18, 30


def lit(frame, gain):
    return replace(frame, color=np.clip(frame.color * gain, 0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def room():
    sequence = synthetic.sequence("room", movers=(), frames=36, camera=CAMERA, seed=3)
    return sequence, [sequence[index] for index in range(len(sequence))]


def run(room, gain, options=()):
    """Results and largest error (m) of a run in which the light changes for a while, and its system."""
    sequence, frames = room
    slam, truth = Slam(CAMERA, Config().override(list(options))), sequence.ground_truth.Ts_world_camera
    results, errors = [], []
    for number, frame in enumerate(frames):
        result = slam.process(lit(frame, gain) if DARK_FROM <= number < DARK_TO else frame)
        results.append(result)
        if result.T_world_camera is not None:
            errors.append(np.linalg.norm((se3.inverse(truth[0]) @ truth[number] - result.T_world_camera)[:3, 3]))
    return results, max(errors), slam


@pytest.fixture(scope="module")
def undisturbed(room):
    return run(room, 1.0)


@pytest.fixture(scope="module")
def without_colors(room):
    return run(room, 1.0, ["tracker.color_weight=0"])[1]


@pytest.mark.parametrize("gain", [0.01, 0.1, 3.0])
def test_no_frame_is_lost_where_the_light_changes_and_the_map_keeps_its_colours(
    room, undisturbed, without_colors, gain
):
    results, error, slam = run(room, gain)
    assert [result.verdict.reason for result in results if result.status == "lost"] == []
    told = gain == 0.1  # else hardly any grey levels are left, or many pixels are saturated
    assert error < (2 * undisturbed[1] if told else without_colors)
    assert [result.blind for result in results[DARK_FROM:DARK_TO]] == [gain < 0.1] * (DARK_TO - DARK_FROM)
    meshes = [one.volume.extract_mesh() for one in (undisturbed[2], slam)]
    means = [mesh.colors.mean(axis=0) for mesh in meshes]
    assert np.allclose(means[0], means[1], atol=6)  # of 255


@pytest.mark.parametrize("gain", [0.07, 0.15, 0.4, 2.0, 3.0])
@pytest.mark.parametrize("contrast", [0.1, 0.2])
def test_the_exposure_is_found_in_spite_of_saturation_and_low_contrast(gain, contrast):
    rng = np.random.default_rng(5)
    of_map = np.clip(rng.normal(0.4, contrast, (60, 80)), 0.01, 0.99)
    image = np.clip(np.round(255 * gain * of_map) / 255, 0, 1).astype(np.float32)
    found, offset = fit_exposure(image, (of_map - image).astype(np.float32), np.ones_like(image))
    shown = (image > 0) & (image < 1)
    assert np.median(np.abs(found * image + offset - of_map)[shown]) < 0.02 + 0.3 / 255 / gain


@pytest.mark.parametrize("gain", [0.1, 3.0])
def test_two_images_of_one_pose_lie_upon_each_other_in_any_light(room, gain):
    sequence, frames = room
    slam, images = Slam(CAMERA), ImageConsistency(Config(), MotionModel(Config().tracker))
    truth = sequence.ground_truth.Ts_world_camera
    right = se3.inverse(truth[8]) @ truth[11]
    last, view = slam.prepare(frames[8]).tracked_at(np.eye(4)), slam.prepare(lit(frames[11], gain))
    start = PoseEstimate.at_origin()
    for T, beside in ((right, False), (right @ se3.exp(np.array([0.15, 0, 0, 0, 0, 0])), True)):
        estimate = replace(start, tracking=replace(start.tracking, T_world_camera=T))
        assert (images.compare(last, view, estimate).shift > MAX_IMAGE_SHIFT) is beside


def test_saturated_colours_do_not_enter_the_map():
    rgb = np.array([[[255, 200, 100], [254, 254, 254], [0, 0, 0]]], np.uint8)
    assert exposed_color(rgb, (0.5, 0.0)).tolist() == [[[0, 0, 0], [127, 127, 127], [0, 0, 0]]]
    assert exposed_color(rgb, (0.95, 0.0))[0, 0, 0] > 240
