"""Preprocessing against slow oracles that follow the equations literally."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import PreprocessConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


def frame(depth, color=None):
    if color is None:
        color = np.random.default_rng(0).integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
    return Frame(1.5, np.asarray(depth, dtype=np.float32), color)


def observe(depth, camera=CAMERA, **config):
    config = {"fill_holes": False, "filter": "none", **config}
    return Preprocessor(camera, PreprocessConfig(**config))(frame(depth))


def noisy_step(seed=1):
    """Two slanted surfaces with a step of 0.8 m between them, Kinect-like noise and single missing pixels."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:48, 0:64]
    depth = np.where(u < 30, 1.2 + 0.004 * v, 2.0 + 0.003 * u)
    depth = depth + rng.normal(0, 0.0015 * depth**2)
    depth[rng.random(depth.shape) < 0.03] = 0
    return depth.astype(np.float32)


def filtered_exactly(depth, alpha, sigma, radius):
    """Equations 4.8-4.11, one pixel at a time, not separable."""
    out = np.zeros_like(depth, dtype=np.float64)
    h, w = depth.shape
    for v, u in zip(*np.nonzero(depth), strict=True):
        z = float(depth[v, u])
        total = norm = 0.0
        for y in range(max(0, v - radius), min(h, v + radius + 1)):
            for x in range(max(0, u - radius), min(w, u + radius + 1)):
                q = float(depth[y, x])
                if q > 0:
                    near = math.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma**2))
                    weight = near * math.exp(-((q - z) ** 2) / (2 * (alpha * z * z) ** 2))
                    total, norm = total + weight * q, norm + weight
        out[v, u] = total / norm
    return out


def filtered_separably(depth, alpha, sigma, radius):
    """One pass down the columns and one along the rows, the range weight (1 - t/16)^8, only taps whose opposite lies in
    the image, in float64."""

    def one_pass(image):
        out = np.zeros_like(image)
        for v, u in zip(*np.nonzero(image), strict=True):
            z = image[v, u]
            total = norm = 0.0
            reach = min(radius, v, image.shape[0] - 1 - v)
            for y in range(v - reach, v + reach + 1):
                q = image[y, u]
                t = ((q - z) / (alpha * z * z)) ** 2
                if q > 0 and t < 16:
                    weight = math.exp(-((y - v) ** 2) / (2 * sigma**2)) * (1 - t / 16) ** 8
                    total, norm = total + weight * q, norm + weight
            out[v, u] = total / norm
        return out

    return one_pass(one_pass(depth.astype(np.float64)).T).T


def mixed_exactly(depth, focal):
    """Pixels between two others on both sides, one at a time."""
    h, w = depth.shape
    out = np.zeros(depth.shape, bool)
    for v, u in zip(*np.nonzero(depth), strict=True):
        z = float(depth[v, u])
        for k in (1, 2):
            gap = max(0.01, 0.012 * z * z) + k * 9.5 / focal * z
            pairs = [(v, u - k, v, u + k), (v - k, u, v + k, u)]
            for y0, x0, y1, x1 in pairs:
                if min(y0, x0) < 0 or y1 >= h or x1 >= w:
                    continue
                low, high = sorted((float(depth[y0, x0]), float(depth[y1, x1])))
                out[v, u] |= low > 0 and low + gap < z < high - gap
    return out


def test_flying_pixels_are_dropped_and_steep_surfaces_kept():
    camera = Camera(500.0, 500.0, 31.5, 23.5, 64, 48)
    depth = noisy_step()
    depth[:, 29] = np.where(depth[:, 29] > 0, np.linspace(1.3, 2.0, 48), 0)  # a column between the two surfaces
    seen = observe(depth, camera, drop_mixed=True).depth
    expected = mixed_exactly(depth, 500.0)
    assert np.array_equal(seen, np.where(expected, 0, depth))
    assert expected[:, 29].mean() > 0.6
    assert expected[:, :28].sum() == expected[:, 32:].sum() == 0
    assert np.array_equal(observe(depth, camera, drop_mixed=False).depth, depth)
    slope = 1.5 * np.tan(np.radians(80)) / 500  # per pixel, of a wall seen at 80 degrees
    steep = np.broadcast_to(1.5 + slope * np.arange(64, dtype=np.float32), (48, 64)).astype(np.float32)
    assert np.array_equal(observe(steep, camera, drop_mixed=True).depth, steep)


def test_bilateral_equals_separable_oracle():
    depth = noisy_step()
    found = observe(depth, filter="bilateral").depth
    assert np.abs(found - filtered_separably(depth, 0.012, 4.0, 6)).max() < 2e-5


def test_bilateral_is_close_to_the_equations_and_removes_noise():
    depth = noisy_step()
    found = observe(depth, filter="bilateral").depth
    exact = filtered_exactly(depth, 0.012, 4.0, 6)
    valid = depth > 0
    v, u = np.mgrid[0:48, 0:64]
    whole = valid & (np.minimum(v, 47 - v) >= 6) & (np.minimum(u, 63 - u) >= 6)
    assert np.sqrt(np.mean((found - exact)[whole] ** 2)) < 1.5e-3  # elsewhere the window is smaller
    truth = np.where(u < 30, 1.2 + 0.004 * v, 2.0 + 0.003 * u)
    before = np.std((depth - truth)[valid])
    after = np.std((found - truth)[valid])
    assert after < 0.5 * before
    assert after < 1.05 * np.std((exact - truth)[valid])
    assert np.abs(found - truth)[valid].max() < 0.02  # nothing leaks across the step


def test_a_slanted_plane_stays_where_it_is():
    """A window that lacks a side, at the border of the image, does not pull a slope to the other."""
    depth = np.repeat(1.0 + 0.004 * np.arange(48, dtype=np.float32)[:, None], 64, axis=1)
    found = observe(depth, filter="bilateral", fill_holes=False).depth
    assert np.abs(found - depth).max() < 1e-5


def test_missing_pixels_neither_give_nor_receive():
    depth = np.full((48, 64), 1.0, np.float32)
    depth[::2, ::3] = 0
    found = observe(depth, filter="bilateral").depth
    assert np.all(found[depth == 0] == 0)
    assert np.allclose(found[depth > 0], 1.0, atol=1e-6)


@pytest.mark.parametrize("radius", [1, 6, 16])
def test_any_values_give_finite_output(radius, monkeypatch):
    rng = np.random.default_rng(3)
    depth = rng.uniform(-1, 8, (48, 64)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    for value in (np.nan, np.inf, -np.inf, 1e-30, 1e30, -1e9):
        depth[rng.random(depth.shape) < 0.03] = value
    for alpha in (1e-9, 0.012, 100.0):
        monkeypatch.setattr("dudmap.core.frames.preprocess.FILTER_ALPHA", alpha)
        result = observe(depth, fill_holes=True, filter="bilateral", filter_radius=radius)
        for level in range(4):
            for image in result.halved(level):
                assert np.isfinite(image).all()
                assert image.min() >= 0
        assert result.depth.max() <= 6.0 + 1e-4


def test_limits():
    depth = np.full((48, 64), 1.0, np.float32)
    depth[0, :6] = [0.49, 0.51, 2.99, 3.01, np.nan, np.inf]
    result = observe(depth, depth_min=0.5, depth_max=3.0)
    assert result.depth[0, :7].tolist() == pytest.approx([0, 0.51, 2.99, 0, 0, 0, 1], abs=1e-6)


def test_small_holes_are_filled_with_the_mean():
    v, u = np.mgrid[0:48, 0:64]
    plane = (1.0 + 0.001 * u + 0.0005 * v).astype(np.float32)
    holes = np.zeros(plane.shape, dtype=bool)
    holes[5, 5] = True
    holes[10:13, 20:23] = True
    holes[20:45, 30:33] = True  # a crack
    filled = observe(np.where(holes, 0, plane), fill_holes=True).depth
    assert np.abs(filled - plane).max() < 3e-3
    assert np.array_equal(filled[~holes], plane[~holes])
    around = plane[3:8, 3:8].copy()
    around[2, 2] = 0
    assert filled[5, 5] == pytest.approx(around.sum() / 24, abs=1e-6)


def test_large_holes_and_depth_edges_stay():
    plane = np.full((48, 64), 1.0, np.float32)
    large = np.zeros(plane.shape, dtype=bool)
    large[10:20, 10:20] = True
    large[30:34, 30:40] = True
    filled = observe(np.where(large, 0, plane), fill_holes=True).depth
    assert np.all(filled[large] == 0)
    step = plane.copy()
    step[:, 30:] = 1.5
    shadow = np.zeros(plane.shape, dtype=bool)
    shadow[:, 29:31] = True
    filled = observe(np.where(shadow, 0, step), fill_holes=True).depth
    assert np.all(filled[shadow] == 0)


def test_colors():
    color = np.zeros((48, 64, 3), np.uint8)
    color[0, 0], color[0, 1], color[0, 2] = (255, 255, 255), (255, 0, 0), (1, 2, 3)
    result = Preprocessor(CAMERA)(frame(np.ones((48, 64)), color))
    assert result.intensity[0, :3].tolist() == pytest.approx(
        [1, 0.299, (0.299 + 2 * 0.587 + 3 * 0.114) / 255], abs=1e-6
    )
    assert np.array_equal(result.rgb, color)


def test_pyramid_matches_blocks():
    rng = np.random.default_rng(5)
    depth = rng.choice([0, 1.0, 1.01, 1.5, 3.0, 3.05], (48, 64)).astype(np.float32)
    result = observe(depth)
    half, intensity = result.halved(1)
    assert half.shape == intensity.shape == CAMERA.scaled(1).shape
    blocks = depth.reshape(24, 2, 32, 2).transpose(0, 2, 1, 3).reshape(24, 32, 4)
    for v in range(24):
        for u in range(32):
            readings = blocks[v, u][blocks[v, u] > 0]
            near = readings.min() if len(readings) else 0
            same = readings[readings <= near + 0.02 * max(1, near)]
            assert half[v, u] == pytest.approx(same.mean() if len(same) else 0, abs=1e-6)
    assert np.allclose(intensity, result.intensity.reshape(24, 2, 32, 2).mean(axis=(1, 3)), atol=1e-6)
    assert result.halved(0)[0] is result.depth
    assert result.halved(3)[0].shape == (6, 8)
    assert result.halved(2)[0] is result.halved(2)[0]


def test_pyramid_of_odd_sizes():
    camera = Camera(60.0, 60.0, 31.5, 23.5, 61, 45)
    for level in range(2):
        depth, intensity = observe(np.ones((45, 61)), camera).halved(level)
        assert depth.shape == intensity.shape == camera.scaled(level).shape
        assert np.allclose(depth, 1)


def test_undistortion():
    """A pattern drawn through the lens model comes out as the model without distortion draws it."""
    k1, k2, p1, p2 = distortion = (0.4, -0.1, 0.01, -0.003)
    camera = Camera(60.0, 61.0, 31.0, 24.0, 64, 48, distortion=distortion)

    def pattern(x, y):
        return 127 + 100 * np.sin(6 * x) * np.cos(5 * y)

    v, u = np.mgrid[0:48, 0:64].astype(np.float64)
    x, y = (u - 31.0) / 60, (v - 24.0) / 61
    straight = pattern(x, y)
    # the distorted image shows at pixel d(x, y) what lies in direction (x, y): invert by fixed-point iteration
    a, b = x.copy(), y.copy()
    for _ in range(50):
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2 * r2
        a, b = (
            (x - 2 * p1 * a * b - p2 * (r2 + 2 * a * a)) / radial,
            (y - p1 * (r2 + 2 * b * b) - 2 * p2 * a * b) / radial,
        )
    color = np.repeat(pattern(a, b).round().astype(np.uint8)[..., None], 3, axis=2)
    depth = (1.5 + 0.6 * a).astype(np.float32)  # 1 cm per pixel
    config = PreprocessConfig(fill_holes=False, filter="none")
    result = Preprocessor(camera, config)(Frame(0.0, depth, color))
    inner = (slice(6, 42), slice(6, 58))
    assert np.abs(result.rgb[..., 0].astype(float) - straight)[inner].max() < 3
    assert np.abs(color[..., 0].astype(float) - straight)[inner].max() > 10
    error = (result.depth - (1.5 + 0.6 * x))[inner]
    assert np.abs(error).max() < 0.0065  # half a pixel and what is stretched
    assert abs(error.mean()) < 0.0005
    assert result.camera.distortion == ()
    assert Preprocessor(camera).camera == result.camera


def test_deterministic_and_independent_of_the_input_afterwards():
    depth = noisy_step()
    preprocess = Preprocessor(CAMERA)
    first = preprocess(frame(depth))
    kept = first.depth.copy(), first.intensity.copy()
    again = preprocess(frame(depth))
    preprocess(frame(noisy_step(2)))
    assert np.array_equal(first.depth, kept[0])
    assert np.array_equal(first.intensity, kept[1])
    assert np.array_equal(first.depth, again.depth)


@pytest.mark.parametrize(
    ("depth", "color"),
    [
        (np.ones((48, 60), np.float32), np.zeros((48, 64, 3), np.uint8)),
        (np.ones((48, 64), np.float32), np.zeros((96, 128, 3), np.uint8)),
        (np.ones((48, 64), np.float32), np.zeros((48, 64), np.uint8)),
        (np.ones((48, 64), np.uint16), np.zeros((48, 64, 3), np.uint8)),
        (np.ones((48, 64), np.float32), np.zeros((48, 64, 3), np.float32)),
    ],
)
def test_unfit_images_are_refused(depth, color):
    with pytest.raises(DatasetError, match=r"expected|must have"):
        Preprocessor(CAMERA)(Frame(0.0, depth, color))


def test_a_mask_goes_back_into_the_recorded_image():
    """Every recorded pixel gets the label of the point its ray meets; checked with the distortion written out."""
    camera = Camera(120.0, 118.0, 81.0, 58.0, 160, 120, distortion=(0.25, -0.6, 0.004, -0.003, 0.5))
    k1, k2, p1, p2, k3 = camera.distortion
    v, u = np.mgrid[0:120, 0:160]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    inside = (u > 110) & (v > 80) & (u < 140) & (v < 105)  # a block far from the centre, where the lens matters
    ud, vd = np.rint(xd * camera.fx + camera.cx).astype(int), np.rint(yd * camera.fy + camera.cy).astype(int)
    recorded = Preprocessor(camera).distorted(inside)
    assert abs(ud[inside] - u[inside]).max() >= 2  # the test has something to see
    border = np.zeros_like(inside)
    border[83:103, 113:138] = True
    assert recorded[vd[border & inside], ud[border & inside]].mean() == 1
    beside = (u > 105) & (u < 109) & (v > 70) & (v < 110)
    assert not recorded[vd[beside], ud[beside]].any()
    both = Preprocessor(camera).mask(recorded)
    assert np.count_nonzero(both != inside) <= 0.1 * np.count_nonzero(inside)  # its rim, by rounding


def test_without_distortion_a_mask_stays_as_it_is():
    mask = np.random.default_rng(5).random(CAMERA.shape) < 0.3
    assert Preprocessor(CAMERA).distorted(mask) is mask


def test_colours_of_another_time_are_left_to_those_who_know_the_motion():
    camera = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
    rng = np.random.default_rng(5)
    depth, color = np.full((120, 160), 2.0, np.float32), rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    late = replace(Calibration.registered(camera), delay=0.02)
    seen = Preprocessor(camera, calibration=late)(Frame(1.0, depth, color))
    assert np.array_equal(seen.rgb, color)
    assert np.array_equal(seen.recorded_rgb, color)
    moved = replace(Calibration.registered(camera), T_color_depth=se3.exp(np.array([0.1, 0, 0, 0, 0, 0])))
    seen = Preprocessor(camera, calibration=moved)(Frame(1.0, depth, color))  # taken together: registered at once
    assert not np.array_equal(seen.rgb, color)
    small = replace(late, camera=camera.resized(80, 60))
    seen = Preprocessor(camera, calibration=small)(Frame(1.0, depth, color[::2, ::2].copy()))
    assert seen.rgb.shape == (120, 160, 3)
    assert seen.recorded_rgb.shape == (60, 80, 3)


def test_readings_outside_the_view_of_the_colour_camera_are_left_out():
    narrow = Calibration(replace(CAMERA, fx=120.0, fy=120.0))
    depth = np.full((48, 64), 2.0, np.float32)
    seen = Preprocessor(CAMERA, PreprocessConfig(filter="none"), narrow)(frame(depth)).depth > 0
    assert seen[13:35, 17:47].all()
    assert not seen[[10, 37]].any()
    assert not seen[:, [14, 49]].any()
    beside = replace(narrow, camera=replace(CAMERA, cx=CAMERA.cx - 1))  # nearer than the continued border
    assert (Preprocessor(CAMERA, PreprocessConfig(filter="none"), beside)(frame(depth)).depth > 0).all()
