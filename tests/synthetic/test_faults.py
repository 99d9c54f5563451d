import json
from dataclasses import fields

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from dudmap import synthetic
from dudmap.errors import ConfigError
from dudmap.geometry.camera import Camera
from dudmap.synthetic import SensorFaults
from dudmap.synthetic.faults import LIMITS, parse_faults
from dudmap.synthetic.folder import write_folder

SMALL = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
UNREGISTERED = SensorFaults(
    color_translation=(0.025, -0.01, 0.004),
    color_rotation_deg=(0.6, -0.4, 1.0),
    color_focal_ratio=0.95,
    color_center_shift=(2.0, -1.5),
)


def moving(faults=None, **arguments):
    """A world in which camera and people move, without noise."""
    usual = {"camera": SMALL, "camera_path": "fast", "frames": 8, "noise": "none", "start_dynamic": True}
    return synthetic.sequence(**(usual | arguments), faults=faults)


def difference(a, b):
    """Mean absolute difference of two colour images, grey values."""
    return np.abs(a.astype(float) - b.astype(float)).mean()


def pixel_grid():
    return np.meshgrid(np.arange(160.0), np.arange(120.0))


def rays(camera):
    u, v = pixel_grid()
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)


def test_default_changes_nothing():
    plain, faultless = moving(noise="kinect"), moving(SensorFaults(), noise="kinect")
    assert np.array_equal(plain[3].color, faultless[3].color)
    assert np.array_equal(plain[3].depth, faultless[3].depth)


def test_unregistered_colour_of_a_plane_is_its_analytic_projection():
    """Colour of every pixel, looked up where the homography of the plane says, in the image of the depth camera."""
    arguments = {"scene": "plane", "movers": (), "camera": SMALL, "frames": 2, "noise": "none", "camera_path": "still"}
    clean = synthetic.sequence(**arguments).exact(0)
    faulty = synthetic.sequence(**arguments, faults=UNREGISTERED)
    camera, T = faulty.color_camera, UNREGISTERED.T_depth_color
    assert camera.fx == pytest.approx(0.95 * SMALL.fx)
    points = (rays(SMALL) * clean.depth[..., None]).reshape(-1, 3)[clean.depth.ravel() > 0]
    normal = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]  # normal . p = 1 on the wall
    assert np.abs(points @ normal - 1).max() < 1e-4
    directions = rays(camera) @ T[:3, :3].T
    scale = (1 - T[:3, 3] @ normal) / (directions @ normal)
    hits = T[:3, 3] + directions * scale[..., None]
    u = hits[..., 0] / hits[..., 2] * SMALL.fx + SMALL.cx
    v = hits[..., 1] / hits[..., 2] * SMALL.fy + SMALL.cy
    inside = (u > 2) & (u < 157) & (v > 2) & (v < 117)
    assert inside.mean() > 0.7

    def vignette(r):  # of the ideal camera, docs/synthetic.md
        return 1 / (1 + 0.12 * (r[..., 0] ** 2 + r[..., 1] ** 2))

    flat = clean.color / vignette(rays(SMALL))[..., None]
    rendered = faulty.exact(0).color

    def error(du, dv):
        at = [v + dv, u + du]
        looked_up = np.stack([map_coordinates(flat[..., c], at, order=3, mode="nearest") for c in range(3)], axis=-1)
        return difference(rendered[inside], (looked_up * vignette(rays(camera))[..., None])[inside])

    exact = error(0, 0)
    assert exact < 1.5  # textures are filtered for the pixel's footprint, which differs by 5 %
    assert min(error(0.2, 0), error(-0.2, 0), error(0, 0.2), error(0, -0.2)) > 1.1 * exact
    assert difference(rendered[inside], clean.color[inside]) > 8
    assert np.array_equal(faulty.exact(0).depth, clean.depth)


def test_delayed_colour_is_that_of_a_later_frame_and_depth_is_not():
    clean, late = moving(), moving(SensorFaults(color_delay=2 / 30))
    for index in (0, 3):
        assert difference(late[index].color, clean[index + 2].color) < 0.05
        assert difference(late[index].color, clean[index].color) > 3
        assert np.array_equal(late[index].depth, clean[index].depth)
        assert np.array_equal(late.mask(index), clean.mask(index))


def test_camera_moves_on_beyond_the_last_frame():
    late = moving(SensorFaults(color_delay=1 / 30))
    assert difference(late[7].color, moving()[7].color) > 1


@pytest.mark.parametrize("readout", [0.03, -0.03])
def test_row_of_a_rolling_shutter_is_the_row_of_the_image_of_its_time(readout):
    delay = 0.01
    rolled = moving(SensorFaults(color_delay=delay, color_readout=readout))[3].color
    late = moving(SensorFaults(color_delay=delay))[3].color
    errors, shears = [], []
    for row in (3, 30, 60, 90, 116):
        moment = delay + readout * ((row + 0.5) / 120 - 0.5)
        at_its_time = moving(SensorFaults(color_delay=moment))[3].color
        errors.append(difference(rolled[row], at_its_time[row]))
        shears.append(difference(late[row], at_its_time[row]))
    assert np.mean(errors) < 0.35 * np.mean([shears[0], shears[-1]])
    assert shears[0] > 2
    assert shears[-1] > 2


def test_blur_and_rolling_shutter_together_average_the_moments_of_a_row():
    blurred = moving(SensorFaults(color_delay=0.02), motion_blur=0.6)[3].color
    moments = 0.02 + np.array([-0.24, -0.12, 0, 0.12, 0.24]) / 30
    mean = np.mean([moving(SensorFaults(color_delay=m)).exact(3).color for m in moments], axis=0)
    assert difference(blurred, mean) < 0.6  # rounding to 8 bits
    assert difference(moving(SensorFaults(color_readout=0.02), motion_blur=0.6)[3].color, blurred) > 0.6


def test_truth_is_written_beside_the_recording(tmp_path):
    write_folder(moving(UNREGISTERED, frames=1), tmp_path / "made", surface=False)
    truth = json.loads((tmp_path / "made" / "sensor_truth.json").read_text())
    assert truth["faults"]["color_translation"] == [0.025, -0.01, 0.004]
    assert truth["color_camera"]["fx"] == pytest.approx(0.95 * SMALL.fx)
    assert truth["color_camera"]["cy"] == pytest.approx(58.0)
    T = np.array(truth["T_depth_color"])
    assert np.allclose(T[:3, 3], UNREGISTERED.color_translation)
    angle = np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(np.linalg.norm(UNREGISTERED.color_rotation_deg), rel=1e-4)


def test_faults_by_name():
    assert parse_faults(["color_delay=0.025", "color_translation=0.025, 0,0"]) == SensorFaults(
        color_delay=0.025, color_translation=(0.025, 0.0, 0.0)
    )
    assert parse_faults(["color_delay=0.01"], UNREGISTERED).color_focal_ratio == 0.95
    assert set(LIMITS) == {field.name for field in fields(SensorFaults)}


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        ("dust=1", "unknown fault 'dust'; known faults: color_translation"),
        ("color_delay=soon", "cannot understand the fault 'color_delay=soon'"),
        ("color_delay=7", "fault color_delay is 7.0; expected a number from -1 to 1"),
        ("color_translation=0.1", "expected 3 numbers from -1 to 1"),
        ("color_delay=0.1,0.2", "expected a number from -1 to 1"),
    ],
)
def test_bad_faults_are_one_sentence(assignment, sentence):
    with pytest.raises(ConfigError) as error:
        parse_faults([assignment])
    assert sentence in str(error.value)
