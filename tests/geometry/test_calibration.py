"""Calibration of a colour camera: file, step, and the registration of its image against a plain NumPy oracle."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.core.frames.color_registration import color_projection, register_color
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import NUM_PARAMETERS, PARAMETERS, Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError

DEPTH = Camera(100.0, 102.0, 47.5, 35.5, 96, 72)
COLOR = Camera(120.0, 121.0, 66.0, 48.0, 128, 96, distortion=(0.05, -0.02, 0.002, -0.001, 0.01))
T_COLOR_DEPTH = se3.exp(np.array([0.025, -0.004, 0.003, 0.01, -0.02, 0.015]))
TWIST = np.array([0.4, -0.3, 0.2, 0.8, -1.0, 0.9])


def calibration(**changes) -> Calibration:
    return Calibration(COLOR, T_COLOR_DEPTH, **({"delay": 0.02, "readout": 0.025} | changes))


WHOLE = "T_color_depth = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\ndelay = 0.0\nreadout = 0.0\n"
WHOLE += "camera = {fx = 100.0, fy = 100.0, cx = 48.0, cy = 36.0, width = 96, height = 72}\n"


def color_pixels(depth, projection, *, camera=DEPTH, color=COLOR):
    """Coordinates u, v (h, w) in the colour image of the pixels of a depth image, moved to its border where they lie
    outside of it: what they show in two images of these coordinates."""
    images = np.meshgrid(np.arange(color.width, dtype=np.float32), np.arange(color.height, dtype=np.float32))
    return [register_color(image, depth, camera, projection) for image in images]


def seen_by_color(points, camera, tau):
    """Pixels (n, 2) of points (n, 3) of the depth camera, each at its own time: exact motion, Brown-Conrady lens."""
    out = []
    for X, t in zip(points, tau, strict=True):
        x, y, z = (T_COLOR_DEPTH @ se3.inverse(se3.exp(t * TWIST)) @ np.append(X, 1))[:3]
        x, y = x / z, y / z
        k1, k2, p1, p2, k3 = camera.distortion
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        out.append(
            [
                (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * camera.fx + camera.cx,
                (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) * camera.fy + camera.cy,
            ]
        )
    return np.array(out)


def test_each_depth_pixel_is_found_where_the_colour_camera_saw_it():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.8, 3.0, DEPTH.shape).astype(np.float32)
    offset = 0.004
    us, vs = color_pixels(depth, color_projection(calibration(), TWIST, offset))
    points = DEPTH.backproject(depth).reshape(-1, 3).astype(np.float64)
    tau = np.full(len(points), offset + 0.02)
    for _ in range(6):  # the row gives the time, and the time the row
        found = seen_by_color(points, COLOR, tau)
        tau = offset + 0.02 + 0.025 * ((np.clip(found[:, 1], 0, COLOR.height) + 0.5) / COLOR.height - 0.5)
    found = np.clip(found, 0, [COLOR.width - 1, COLOR.height - 1])
    error = np.hypot(us.ravel() - found[:, 0], vs.ravel() - found[:, 1])
    inside = np.all((found > 0) & (found < [COLOR.width - 1, COLOR.height - 1]), axis=1)
    assert inside.mean() > 0.7
    # the kernel stops after one such step, leaves the lens out of the row's time, and expands to the second order
    assert error.max() < 0.06


def test_pixels_without_a_reading_take_the_depth_of_a_neighbour_in_their_row():
    depth = np.full(DEPTH.shape, 2.0, np.float32)
    holes = depth.copy()
    holes[10, 30:60] = holes[20, :40] = holes[30, 50:] = holes[40] = 0
    projection = color_projection(calibration(delay=0.0, readout=0.0), np.zeros(6), 0.0)
    full, filled = (color_pixels(d, projection) for d in (depth, holes))
    assert np.array_equal(full[0], filled[0])
    assert np.array_equal(full[1], filled[1])


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_colours_are_interpolated_between_four_pixels(dtype):
    rng = np.random.default_rng(2)
    depth = rng.uniform(0.8, 3.0, DEPTH.shape).astype(np.float32)
    color = rng.uniform(0, 255, (*COLOR.shape, 3) if dtype == np.uint8 else COLOR.shape).astype(dtype)
    projection = color_projection(calibration(), TWIST, 0.0)
    us, vs = (at.astype(np.float64)[..., *[None] * (color.ndim - 2)] for at in color_pixels(depth, projection))
    u0, v0 = np.minimum(us, COLOR.width - 2).astype(int), np.minimum(vs, COLOR.height - 2).astype(int)
    a, d = us - u0, vs - v0
    if color.ndim == 3:
        u0, v0 = u0[..., 0], v0[..., 0]
    (top_left, top), (left, below) = ((color[v0 + n, u0], color[v0 + n, u0 + 1]) for n in (0, 1))
    expected = (1 - d) * ((1 - a) * top_left + a * top) + d * ((1 - a) * left + a * below)
    registered = register_color(color, depth, DEPTH, projection)
    assert np.abs(registered - expected).max() < (0.51 if dtype == np.uint8 else 0.01)


def test_a_plane_seen_by_two_cameras_has_one_colour():
    """A slanted plane with an analytic texture, rendered by the colour camera and registered to the depth camera."""
    camera = Camera(180.0, 180.0, 79.5, 59.5, 160, 120)
    other = Calibration(Camera(200.0, 200.0, 90.0, 64.0, 180, 132), se3.exp(np.array([0.03, 0.01, 0, 0.02, 0.01, 0.1])))
    normal, reach = np.array([0.2, -0.1, 0.95]), 1.4

    def view(of: Camera, T_depth_this):
        v, u = np.mgrid[: of.height, : of.width]
        rays = np.stack([(u - of.cx) / of.fx, (v - of.cy) / of.fy, np.ones(u.shape)], -1) @ T_depth_this[:3, :3].T
        t = (reach - normal @ T_depth_this[:3, 3]) / (rays @ normal)
        X = rays * t[..., None] + T_depth_this[:3, 3]
        shade = 127 + 60 * np.sin(9 * X[..., 0]) * np.cos(8 * X[..., 1])
        return t.astype(np.float32), np.repeat(np.round(shade)[..., None], 3, axis=2).astype(np.uint8)

    depth, color = view(camera, np.eye(4))
    _, elsewhere = view(other.camera, se3.inverse(other.T_color_depth))
    registered = register_color(elsewhere, depth, camera, color_projection(other, np.zeros(6), 0.0))
    difference = np.abs(registered[20:-20, 20:-20].astype(int) - color[20:-20, 20:-20])
    assert difference.mean() < 0.5
    assert difference.max() <= 2
    assert np.abs(elsewhere[:120, :160].astype(int) - color).mean() > 10


@pytest.mark.parametrize("delay", [0.0, 0.01])
@pytest.mark.parametrize("vignetting", [0.0, 0.4, -0.1])
def test_the_light_that_vignetting_took_is_given_back(vignetting, delay):
    """With a delay, though nothing moves, each pixel is looked up; without one it stays where it is."""
    camera = Camera(100.0, 100.0, 47.5, 35.5, 96, 72)
    v, u = np.indices(camera.shape)
    lost = np.exp(-vignetting * (np.square(u - 47.5) + np.square(v - 35.5)) / (47.5**2 + 35.5**2))
    seen = np.repeat(np.round(200 * lost)[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)
    projection = color_projection(Calibration(camera, vignetting=vignetting, delay=delay), np.zeros(6), 0.0)
    depth = np.full(camera.shape, 2.0, np.float32)
    np.testing.assert_allclose(register_color(seen, depth, camera, projection), 200, atol=1)
    shades = register_color(lost.astype(np.float32), depth, camera, projection)
    np.testing.assert_allclose(shades, 1, atol=2e-3)
    assert (register_color(np.full_like(seen, 254), depth, camera, projection) >= 200).all()  # never around the end


def test_a_step_and_its_inverse():
    step = np.linspace(-0.02, 0.03, NUM_PARAMETERS)
    start = calibration()
    end = start.retract(step)
    assert np.allclose(start.step_to(end), step, atol=1e-12)
    assert end.camera.fy / start.camera.fy == pytest.approx(np.exp(step[6]))
    assert end.readout == pytest.approx(start.readout + step[12])


def test_the_file_holds_everything(tmp_path):
    sigma = np.array([*np.arange(12) / 7, np.nan])
    before = calibration(sigma=sigma, estimated=("delay",), vignetting=0.2, vignetting_sigma=0.01)
    before = replace(before, depth_readout=0.03, depth_readout_sigma=0.002)
    before.save(tmp_path / "calibration.toml")
    after = Calibration.load(tmp_path / "calibration.toml")
    assert after.camera == before.camera
    assert np.array_equal(after.T_color_depth, before.T_color_depth)
    assert (after.delay, after.readout, after.estimated) == (before.delay, before.readout, before.estimated)
    assert np.array_equal(after.sigma, before.sigma, equal_nan=True)
    assert (after.vignetting, after.vignetting_sigma) == (0.2, 0.01)
    assert (after.depth_readout, after.depth_readout_sigma) == (0.03, 0.002)
    (tmp_path / "old.toml").write_text("\n".join(
        line for line in (tmp_path / "calibration.toml").read_text().splitlines() if "vignetting" not in line
    ))  # fmt: skip
    assert Calibration.load(tmp_path / "old.toml").vignetting == 0
    assert len(PARAMETERS) == len(after.sigma)


def test_colours_count_in_motion_as_well_as_their_time_is_known():
    sigma = np.full(len(PARAMETERS), np.nan)
    sigma[-2:] = 0.001, 0.002 * np.sqrt(12)
    known = calibration(sigma=sigma, estimated=("delay", "readout"), depth_readout_sigma=0.002 * np.sqrt(12))
    assert known.time_sigma(0.009) == pytest.approx(0.003)
    assert replace(known, estimated=()).time_sigma(0.009) == 0.009
    assert replace(known, depth_readout_sigma=np.nan).time_sigma(0.009) == 0.009


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("delay = [", "not valid TOML"),
        ("delay = 0.0\nreadout = 0.0", "lacks camera"),
        ("camera = 3", "cannot understand"),
        (f"{WHOLE}vignetting = 5.0", "vignetting is 5.0; expected a number from -2 to 2"),
        (f"{WHOLE}vignetting = nan", "vignetting is nan"),
    ],
)
def test_a_bad_file_gets_a_sentence(tmp_path, text, complaint):
    (tmp_path / "calibration.toml").write_text(text)
    with pytest.raises(DatasetError, match=complaint):
        Calibration.load(tmp_path / "calibration.toml")


def test_a_missing_file_gets_a_sentence(tmp_path):
    with pytest.raises(DatasetError, match="cannot read"):
        Calibration.load(tmp_path / "calibration.toml")


def test_only_a_registered_camera_is_taken_as_it_is():
    assert Calibration.registered(DEPTH).is_registered(DEPTH)
    assert not calibration().is_registered(DEPTH)
    assert not Calibration(DEPTH, vignetting=0.1).is_registered(DEPTH)
    for index in range(NUM_PARAMETERS):
        step = np.zeros(NUM_PARAMETERS)
        step[index] = 1e-3
        assert not Calibration.registered(DEPTH).retract(step).is_registered(DEPTH)
