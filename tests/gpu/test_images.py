"""Operations on images: the device against the CPU."""

import numpy as np
import pytest

from dudmap.kernels.parameters import FilterParameters, SensorNoise
from small_maps import CAMERA

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

FILTER = FilterParameters(
    depth_min=0.2, depth_max=5.0, drop_mixed=False, steepest=0.07, fill_holes=True, hole_noise=0.01, smooth=True,
    alpha=0.012, sigma_px=4.0, radius=6,
)  # fmt: skip


@pytest.mark.parametrize(
    "changed", [{}, {"drop_mixed": True}, {"fill_holes": False}, {"smooth": False}, {"radius": 1}], ids=str
)
def test_the_filter_is_that_of_the_cpu(cpu, gpu, depth, changed):
    """The same pixels have a depth; depths agree to rounding (a micrometre)."""
    parameters = FILTER._replace(**changed)
    expected, found = cpu.filter(depth, parameters), gpu.filter(depth, parameters)
    assert np.array_equal(expected > 0, found > 0)
    assert 0.5 < (found > 0).mean() < 1
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_filtered_depth_without_smoothing_is_equal(cpu, gpu, depth):
    parameters = FILTER._replace(smooth=False, fill_holes=False, drop_mixed=True)
    np.testing.assert_array_equal(gpu.filter(depth, parameters), cpu.filter(depth, parameters))


def test_intensity_and_halving_are_those_of_the_cpu(cpu, gpu, recording, depth):
    rgb = np.ascontiguousarray(recording[0].color)
    expected, found = cpu.intensity(rgb), gpu.intensity(rgb)
    assert (found != expected).mean() < 1e-4  # all, on processors with fused multiplication and addition
    for a, b in zip(gpu.halve(depth, expected, 0.02), cpu.halve(depth, expected, 0.02), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("voxel_size", [0.001, 0.03, 0.3])
def test_mean_colours_are_those_of_the_cpu(cpu, gpu, recording, depth, voxel_size):
    """Sums of bytes are exact; a mean may be rounded otherwise on a processor that fuses its last operations."""
    arguments = np.ascontiguousarray(recording[0].color), depth, 130.0, voxel_size
    expected, found = cpu.footprint_colors(*arguments), gpu.footprint_colors(*arguments)
    assert (found != expected).mean() < 1e-4
    assert (expected != arguments[0]).any() == (voxel_size > 0.01)


def test_weights_of_readings_are_equal(cpu, gpu, depth):
    arguments = cpu.filter(depth, FILTER), CAMERA.intrinsics, SensorNoise(0.001, 0.0019), 16.0
    expected, found = cpu.reading_weights(*arguments), gpu.reading_weights(*arguments)
    assert len(np.unique(found)) > 2
    np.testing.assert_array_equal(found, expected)


def test_labels_are_those_of_the_cpu(cpu, gpu, depth):
    random = np.random.default_rng(5)
    log_odds = random.normal(0, 2, depth.shape).astype(np.float32)
    tolerance = np.full(depth.shape, 0.05, np.float32)
    expected = cpu.label(log_odds, depth, tolerance, 2.0, 6)
    np.testing.assert_allclose(gpu.label(log_odds, depth, tolerance, 2.0, 6), expected, atol=1e-6)


def test_results_can_not_be_changed_since_the_device_keeps_them(gpu, depth):
    found = gpu.filter(depth, FILTER)
    with pytest.raises(ValueError, match="read-only"):
        found[0, 0] = 1.0


def test_an_array_that_was_changed_is_uploaded_again(cpu, gpu, depth):
    image, shade = depth.copy(), np.zeros(depth.shape, np.float32)
    first = gpu.halve(image, shade, 0.02)[0].copy()
    image += 0.5 * (image > 0)
    second = gpu.halve(image, shade, 0.02)[0]
    assert not np.array_equal(first, second)
    np.testing.assert_allclose(second, cpu.halve(image, shade, 0.02)[0], atol=1e-6)
