"""Operations on images: the device against the CPU."""

import numpy as np
import pytest

from dudmap.core.backends.parameters import FilterParameters

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


def test_an_array_that_was_changed_is_uploaded_again(cpu, gpu, depth):
    image, shade = depth.copy(), np.zeros(depth.shape, np.float32)
    first = gpu.halve(image, shade, 0.02)[0].copy()
    image += 0.5 * (image > 0)
    second = gpu.halve(image, shade, 0.02)[0]
    assert not np.array_equal(first, second)
    np.testing.assert_allclose(second, cpu.halve(image, shade, 0.02)[0], atol=1e-6)
