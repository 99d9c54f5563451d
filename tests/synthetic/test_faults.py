import json
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from dudmap.core.geometry.camera import Camera
from dudmap.errors import ConfigError
from dudmap.lab import synthetic
from dudmap.lab.synthetic import SensorFaults
from dudmap.lab.synthetic.color_camera import (
    LARGEST_GAIN,
    TARGET_LEVEL,
    exposure_gains,
    with_flying_pixels,
)
from dudmap.lab.synthetic.faults import LIMITS, parse_faults
from dudmap.lab.synthetic.folder import write_folder
from dudmap.lab.synthetic.render import Rendering
from dudmap.lab.synthetic.sensors import CAMERAS, SENSORS, Sensor

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
    found = parse_faults(["color_delay=0.025", "color_translation=0.025, 0,0"])
    assert found == {"color_delay": 0.025, "color_translation": (0.025, 0.0, 0.0)}
    named = synthetic.sequence(sensor="kinect_v2", faults=found, camera=(160, 120), frames=2)
    assert named.faults == replace(CAMERAS["kinect_v2"].faults, **found)
    assert named.camera == CAMERAS["kinect_v2"].camera(160, 120)
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
        SensorFaults(**parse_faults([assignment]))
    assert sentence in str(error.value)


def test_lens_distortion_is_that_of_brown_and_conrady():
    """The colour of a distorted pixel is found in the clean image where the model says, computed here."""
    k1, k2, p1, p2 = 0.15, -0.1, 0.004, -0.003
    clean = moving().exact(3).color
    distorted = moving(SensorFaults(color_distortion=(k1, k2, p1, p2))).exact(3).color
    u, v = pixel_grid()
    x, y = (u - SMALL.cx) / SMALL.fx, (v - SMALL.cy) / SMALL.fy
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    at = [yd * SMALL.fy + SMALL.cy, xd * SMALL.fx + SMALL.cx]
    inside = (at[0] > 2) & (at[0] < 117) & (at[1] > 2) & (at[1] < 157)
    straight = np.stack([map_coordinates(distorted[..., c], at, order=3) for c in range(3)], axis=-1)
    assert difference(straight[inside], clean[inside]) < 0.25 * difference(distorted[inside], clean[inside])


def test_automatic_exposure_is_a_first_order_loop():
    times = np.arange(60) / 30
    levels = np.where(times < 0.5, 2 * TARGET_LEVEL, TARGET_LEVEL)  # the light is halved
    gains = exposure_gains(levels, times, lag=0.3)
    assert gains[:16] == pytest.approx(0.5)
    late = times > 0.55
    assert np.log2(gains[late]) == pytest.approx(-np.exp(-(times[late] - times[15]) / 0.3), abs=1e-6)
    assert exposure_gains(np.full(3, 1.0), times[:3], 0.3) == pytest.approx(LARGEST_GAIN)


def test_exposure_white_balance_and_vignetting_are_as_the_truth_says():
    faults = SensorFaults(auto_exposure=0.2, white_balance_drift=0.1, vignetting=0.4)
    clean, faulty = moving(frames=50), moving(faults, frames=50)
    truth = faulty.sensor_truth()
    assert np.ptp(truth["exposure_gains"]) > 0.02
    before = clean.exact(40).color
    expected = before * truth["exposure_gains"][40] * np.array(truth["white_balance_rgb"][40])
    u, v = pixel_grid()
    expected *= (1 - 0.4 * ((u - 79.5) ** 2 + (v - 59.5) ** 2) / (79.5**2 + 59.5**2))[..., None]
    assert np.abs(np.clip(expected, 0, 255) - faulty[40].color).max() < 0.6
    means = truth["white_balance_rgb"][40]
    assert means[0] > 1.08
    assert means[2] < 0.92


def test_jpeg_blurs_detail_but_little():
    clean, coarse = moving()[0].color, moving(SensorFaults(jpeg_quality=30))[0].color
    assert 1 < difference(clean, coarse) < 15
    assert coarse.dtype == np.uint8
    assert coarse.flags["C_CONTIGUOUS"]


def test_systematic_depth_errors_follow_the_written_formula(tmp_path):
    faults = SensorFaults(depth_scale_error=0.01, depth_offset=-0.018, depth_bands=0.002, depth_distortion=0.01)
    recording = moving(faults, frames=1)
    write_folder(recording, tmp_path / "made", surface=False)
    truth = json.loads((tmp_path / "made" / "sensor_truth.json").read_text())
    z, (u, v) = recording.exact_depth(0).astype(float), pixel_grid()
    wave = sum(
        size * np.cos(np.pi * (a * u / 160 + b * v / 120) + phase + turn * z)
        for size, a, b, phase, turn in truth["depth_distortion_modes"]
    )
    z1 = z * (1.01 + z / 2 * wave) - 0.018
    bands = np.array(truth["depth_bands_per_m"])
    expected = 1 / (1 / z1 + bands[(u * len(bands) / 160).astype(int)])
    assert np.abs(recording[0].depth - expected)[z > 0].max() < 1e-4
    assert bands.mean() == pytest.approx(0, abs=1e-12)
    assert np.sqrt(np.mean(bands**2)) == pytest.approx(0.002)


def test_smooth_distortion_has_its_size_over_many_sensors():
    faults = SensorFaults(depth_distortion=0.01)
    u, v = pixel_grid()
    sizes = [
        np.mean((moving(faults, frames=1, seed=seed)._depth_faults.multiplier(u, v, np.full_like(u, 2.0)) - 1) ** 2)
        for seed in range(30)
    ]
    assert np.sqrt(np.mean(sizes)) == pytest.approx(0.01, rel=0.15)


def test_flying_pixels_lie_between_two_surfaces():
    depth = np.full((40, 60), 3.0, np.float32)
    depth[:, :30] = 1.0
    mixed = with_flying_pixels(depth, 0.5, np.random.default_rng(0))
    changed = mixed != depth
    assert set(np.flatnonzero(changed.any(axis=0))) == {29, 30}
    assert changed[:, 29:31].mean() == pytest.approx(0.5, abs=0.15)
    assert np.all((mixed[changed] > 1) & (mixed[changed] < 3))


@pytest.mark.parametrize("noise", ["kinect_v2", "l515", "iphone"])
def test_noise_of_time_of_flight_has_the_stated_deviation(noise):
    model = SENSORS[noise]
    for z in (1.0, 2.5):
        exact = np.full((240, 320), z, np.float32)
        color = np.zeros((240, 320, 3), np.float32)
        ideal = Rendering(exact, np.zeros(exact.shape, np.int16), color, np.ones_like(exact))
        sensor = Sensor(noise, 1)
        errors = np.stack([sensor.measure(ideal, 300.0, k)[0] - exact for k in range(12)])
        sigma = model.noise[0] + model.noise[1] * z + model.noise[2] * z * z
        seen = errors > -z / 2
        assert seen.mean() > 0.99
        blur = 0.97 if model.native_width else 1.0  # interpolation averages a little
        assert errors[seen].std() == pytest.approx(blur * sigma, rel=0.06)
        assert abs(errors[seen].mean()) < 0.15 * sigma


def test_dropped_and_late_frames():
    faults = SensorFaults(dropped_frames=0.3, late_frames=0.2)
    recording = moving(faults, frames=300)
    steps = np.diff(recording.timestamps) * 30
    assert len(recording) == pytest.approx(210, abs=25)
    assert recording.timestamps[0] == 0
    assert steps.min() > 0.3
    assert (steps > 1.5).mean() > 0.2
    late = np.abs(recording.timestamps * 30 - np.floor(recording.timestamps * 30 + 1e-4)) > 0.05
    assert late.mean() == pytest.approx(0.2, abs=0.07)
    assert np.array_equal(recording.ground_truth.timestamps, recording.timestamps)


@pytest.mark.parametrize("name", list(CAMERAS))
def test_cameras_have_their_noise_and_faults(name):
    recording = synthetic.sequence(sensor=name, frames=2, movers=())
    assert recording.faults == CAMERAS[name].faults
    assert recording.camera.fx == pytest.approx(320 / np.tan(np.radians(CAMERAS[name].field_of_view) / 2))
    assert (recording[0].depth > 0).mean() > 0.6
    other = synthetic.sequence(sensor=name, frames=2, movers=(), faults=SensorFaults(), noise="none", motion_blur=0.0)
    assert np.array_equal(other[1].depth, other.exact_depth(1))


def test_command_line_of_sensors(tmp_path):
    from typer.testing import CliRunner

    from dudmap.cli import application_of

    arguments = [str(tmp_path / "out"), "--scene", "box", "--size", "64x48", "--max-frames", "2", "--quiet"]
    chosen = ["--sensor", "kinect_v2", "--fault", "color_delay=0.03", "--fault", "depth_offset=0"]
    result = CliRunner().invoke(application_of("synth"), [*arguments, *chosen])
    assert result.exit_code == 0, result.output
    faults = json.loads((tmp_path / "out" / "sensor_truth.json").read_text())["faults"]
    assert (faults["color_delay"], faults["depth_offset"], faults["flying_pixels"]) == (0.03, 0, 0.5)
    assert json.loads((tmp_path / "out" / "scene.json").read_text())["noise"] == "kinect_v2"
    wrong = CliRunner().invoke(application_of("synth"), [*arguments[:1], "--sensor", "eye"])
    assert isinstance(wrong.exception, ConfigError)
    assert "unknown sensor 'eye'; known sensors: kinect_v1" in str(wrong.exception)
