"""Labels of a frame: the device against the CPU, and components against the scan that numbers them."""

from functools import partialmethod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dudmap.gpu.device import make_backend

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from failing import FULL, LOST, Device
from streamed import NAME, Gpu
from test_images import FILTER

from dudmap.gpu import backend as backends
from dudmap.gpu import faults
from dudmap.gpu.backend import WarpBackend
from dudmap.gpu.staging import Staging
from dudmap.gpu.streams import HostQueue
from dudmap.kernels.evidence import BINS, EvidenceParameters, NoiseParameters
from dudmap.kernels.parameters import SURFACE, UNKNOWN, MapSample
from dudmap.kernels.reprojection import ReprojectionTarget
from dudmap.kernels.segmentation import SegmentImage
from small_maps import CAMERA

PARAMETERS = EvidenceParameters(2.3, -0.45, 6.0, 0.02, 3.0)
SHAPE = CAMERA.shape
SEGMENTS = 3, 2, 0.2


@pytest.fixture(scope="module")
def smooth(cpu, depth):
    return cpu.filter(depth, FILTER)


@pytest.fixture(scope="module")
def frame(smooth):
    """A sample of a map, and the standard deviation of its distances."""
    random = np.random.default_rng(7)
    occupancy = random.integers(0, 3, SHAPE).astype(np.uint8)
    distance = np.where(occupancy == SURFACE, random.normal(0, 0.03, SHAPE), np.nan).astype(np.float32)
    sigma = (0.002 + 0.002 * smooth**2).astype(np.float32)
    return MapSample(distance, np.zeros(SHAPE, np.float32), occupancy), sigma


@pytest.fixture(scope="module")
def older(recording, cpu):
    """Older frames of the recording."""
    T, shade = recording.ground_truth.Ts_world_camera, np.zeros(SHAPE, np.float32)
    images = [cpu.filter(recording[n].depth.astype(np.float32), FILTER) for n in (1, 3, 5)]
    return [
        ReprojectionTarget(np.linalg.inv(T[n]) @ T[0], image, shade, (image > 2.5).astype(np.uint8))
        for n, image in zip((1, 3, 5), images, strict=True)
    ]


@pytest.mark.parametrize("scale", [0.0, 0.0019])
def test_the_noise_of_readings_is_that_of_the_cpu(cpu, gpu, depth, scale):
    """To rounding; the images come down when they are read, also after the device was lost."""
    parameters = NoiseParameters(0.001, scale, 6.4e-5, 3.0, 0.05, 0.02, 3.0, 1.5, 0.01)
    expected, found = cpu.reading_noise(depth, parameters), gpu.reading_noise(depth, parameters)
    for one, other in zip(expected, found, strict=True):
        assert one.dtype == np.float32
        np.testing.assert_allclose(np.asarray(other), one, rtol=3e-7)
    z = depth.astype(np.float64)
    np.testing.assert_allclose(expected.sigma, np.hypot(0.001 + scale * z**2, 0.008), rtol=1e-6)
    assert (expected.bounded_sigma >= np.float32(0.01)).all()
    assert (expected.gap >= np.float32(0.03)).all()


def test_noise_that_is_lost_with_the_device_is_computed_anew(cpu, gpu, depth, monkeypatch):
    parameters = NoiseParameters(0.001, 0.0019, 6.4e-5, 3.0, 0.05, 0.02, 3.0, 1.5, 0.01)
    found, device = gpu.reading_noise(depth, parameters), Device(monkeypatch)
    device.breaks(LOST)
    with faults.told_to(lambda sentence: None):
        for one, other in zip(cpu.reading_noise(depth, parameters), found, strict=True):
            np.testing.assert_array_equal(np.asarray(other), one)
    faults.forget()


def tolerances(depth):
    return (0.01 + 0.02 * depth).astype(np.float32)


def labelled(backend, frame, depth, older):
    """Everything that the labels of a frame need from a device."""
    sample, sigma = frame
    noise, tolerance = np.full(SHAPE, 0.05, np.float32), tolerances(depth)
    made = backend.reading_noise(depth, NoiseParameters(0.002, 0.002, 0.0, 3.0, 0.02, 0.02, 3.0, 1.5, 0.01))
    counts = backend.residual_counts(sample, depth, made.sigma)
    free = backend.free_space(depth, np.zeros(SHAPE, np.float32), CAMERA.intrinsics, noise, older, 3)
    odds = backend.log_odds(sample, sigma, PARAMETERS, True, free)
    probability = backend.label(odds, depth, tolerance, 4.0, 4)
    seeds = (probability < 0.5) & (depth > 0)
    moving = backend.moving_regions(seeds, odds, depth, tolerance, 15.36, 0.25)
    labels, count = backend.segment_surface(depth, CAMERA.intrinsics, tolerance, *SEGMENTS)
    before = backend.seen_marked(depth, depth, CAMERA.intrinsics, older[0], 0.1)
    in_segments = backend.segment_counts(labels, count, (before, moving))
    started = in_segments[2] > 0.3 * in_segments[0]
    segments = SegmentImage(labels, count, made.bounded_sigma, np.ascontiguousarray(depth / 10), 3)
    known, sums = backend.compare_segments(sample, segments, started, moving, depth, (0.98, 0.01))
    others = backend.compare_with_frame(depth, depth, CAMERA.intrinsics, older[1], segments, 4)
    images = [np.asarray(image) for image in (free, odds, before, known)]
    return *counts, *images, probability, moving, labels, count, *in_segments, *sums, *others


def test_counts_of_residuals_are_those_of_the_cpu(cpu, gpu, frame, smooth):
    """A residual on the border of a bin may be counted in the next one."""
    (expected, share), (found, other) = (backend.residual_counts(frame[0], smooth, frame[1]) for backend in (cpu, gpu))
    assert (np.count_nonzero(expected), found.sum()) > (50, 1000)
    assert found.sum() == expected.sum()
    assert np.abs(np.cumsum(found - expected)).max() <= 1
    assert other == share == np.mean((frame[0].occupancy == UNKNOWN)[smooth > 0])


@pytest.mark.parametrize("free_space", [False, True])
def test_log_odds_are_those_of_the_cpu(cpu, gpu, frame, free_space):
    seen = np.random.default_rng(1).random(SHAPE) < 0.1
    for seen_free in (None, seen):
        expected, found = (
            np.asarray(backend.log_odds(frame[0], frame[1], PARAMETERS, free_space, seen_free))
            for backend in (cpu, gpu)
        )
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert (expected[seen] == -6).all() == (free_space and seen_free is not None)
    assert len(np.unique(expected)) > 1000


def test_free_space_is_that_of_the_cpu(cpu, gpu, smooth, older):
    """A reading that lies on the border between two pixels of an older frame may count as the other one's."""
    noise, shade = np.full(SHAPE, 0.02, np.float32), np.zeros(SHAPE, np.float32)
    for targets, side in ((older, 3), (older[2:], 5), ([], 3)):
        expected, found = (
            np.asarray(backend.free_space(smooth, shade, CAMERA.intrinsics, noise, targets, side))
            for backend in (cpu, gpu)
        )
        assert found.dtype == bool
        assert (found != expected).mean() < 1e-3
        assert expected.any() == bool(targets)


def test_moving_regions_are_those_of_the_cpu(cpu, gpu, smooth):
    random = np.random.default_rng(2)
    for share, step in ((0.6, 0.04), (0.8, 0.1)):
        odds = np.where(random.random(SHAPE) < share, -2, 2).astype(np.float32)
        seeds = (random.random(SHAPE) < 0.1) & (smooth > 0)
        tolerance = (step * random.random(SHAPE)).astype(np.float32)  # most links hold in one direction only
        expected = cpu.moving_regions(seeds, odds, smooth, tolerance, 15.36, 0.1)
        assert 0.01 < expected.mean() < 0.9
        np.testing.assert_array_equal(gpu.moving_regions(seeds, odds, smooth, tolerance, 15.36, 0.1), expected)


@pytest.mark.parametrize("random_steps", [False, True])
def test_segments_have_the_numbers_of_the_cpu(cpu, gpu, smooth, random_steps):
    tolerance = tolerances(smooth)
    if random_steps:
        tolerance *= np.random.default_rng(4).random(SHAPE).astype(np.float32)
    expected, count = cpu.segment_surface(smooth, CAMERA.intrinsics, tolerance, *SEGMENTS)
    found, other = gpu.segment_surface(smooth, CAMERA.intrinsics, tolerance, *SEGMENTS)
    assert count > 20
    assert other == count
    np.testing.assert_array_equal(found, expected)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(2, 24), st.integers(2, 24), st.floats(0.02, 0.6))
def test_components_are_those_of_the_scan(seed, height, width, step):
    """Depths and steps of a whole number of units, so that nothing is rounded; links go in one direction often."""
    random, cpu, gpu = np.random.default_rng(seed), make_backend("cpu"), make_backend("warp-cpu")
    depth = (1 + np.round(random.random((height, width)) * 64) / 64).astype(np.float32)
    depth[random.random((height, width)) < 0.1] = 0
    tolerance = (np.round(64 * step * random.random((height, width))) / 64).astype(np.float32)
    odds = random.choice(np.array([-1, 3], np.float32), (height, width))
    seeds = (random.random((height, width)) < 0.05) & (depth > 0)
    arguments = seeds, odds, depth, tolerance, 2.0, 0.3
    np.testing.assert_array_equal(gpu.moving_regions(*arguments), cpu.moving_regions(*arguments))


def test_rounds_go_on_until_nothing_changes(cpu, gpu, monkeypatch):
    """A row of links from the right to the left only, longer than the first rounds."""
    device, width = Device(monkeypatch), 33
    steps = np.arange(1, width + 1) / 128
    depth, tolerance = np.zeros((2, width), np.float32), np.zeros((2, width), np.float32)
    depth[0], tolerance[0] = 1 + np.cumsum(steps), steps + 1 / 256  # each more than the step to the left alone
    seeds = np.zeros(depth.shape, bool)
    seeds[0, -1] = True
    arguments = seeds, np.zeros(depth.shape, np.float32), depth, tolerance, 1.0, 0.0
    found = gpu.moving_regions(*arguments)
    assert found[0].all()
    assert device.launched.count("begin") > 1
    np.testing.assert_array_equal(found, cpu.moving_regions(*arguments))


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_streams_changes_no_label(monkeypatch, frame, smooth, older, seed):
    expected = labelled(WarpBackend("cpu"), frame, smooth, older)
    monkeypatch.setattr(backends, "_IMAGES", {})
    gpu = Gpu(monkeypatch, seed)
    backend = WarpBackend(NAME)
    for _ in range(3):  # the launches are a graph from the second time on
        for a, b in zip(labelled(backend, frame, smooth, older), expected, strict=True):
            np.testing.assert_array_equal(a, b)
    assert gpu.launched > 1


def test_what_was_marked_is_that_of_the_cpu(cpu, gpu, smooth, older):
    for target, gap in zip(older, (0.02, 0.1, 1.0), strict=True):
        arguments = smooth, smooth, CAMERA.intrinsics, target, gap
        expected, found = (np.asarray(backend.seen_marked(*arguments)) for backend in (cpu, gpu))
        assert 0.05 < expected.mean() < 0.95
        assert (found != expected).mean() < 1e-3


def test_counts_of_segments_are_those_of_the_cpu(cpu, gpu, smooth):
    labels, count = cpu.segment_surface(smooth, CAMERA.intrinsics, tolerances(smooth), *SEGMENTS)
    masks = [np.random.default_rng(6).random(SHAPE) < share for share in (0.1, 0.7)]
    for chosen in ((), masks):
        expected, found = (backend.segment_counts(labels, count, chosen) for backend in (cpu, gpu))
        np.testing.assert_array_equal(found, expected)
        assert len(found) == 1 + len(chosen)


@pytest.mark.parametrize("window", [3, 5])
def test_sums_over_segments_are_those_of_the_cpu(cpu, gpu, frame, smooth, window):
    labels, count = cpu.segment_surface(smooth, CAMERA.intrinsics, tolerances(smooth), *SEGMENTS)
    random = np.random.default_rng(8)
    difference = random.normal(0, 0.1, SHAPE).astype(np.float32)
    difference[random.random(SHAPE) < 0.1] = np.nan
    sample, started = frame[0]._replace(difference=difference), random.random(count + 1) < 0.5
    shade, gradient = (random.random(SHAPE).astype(np.float32) for _ in range(2))
    dynamic = random.random(SHAPE) < 0.4
    segments = SegmentImage(labels, count, frame[1], gradient, window)
    arguments = sample, segments, started, dynamic, shade, (1.1, -0.02)
    (mask, expected), (other, found) = (backend.compare_segments(*arguments) for backend in (cpu, gpu))
    np.testing.assert_array_equal(np.asarray(other), mask)
    assert 0.1 < mask.mean() < dynamic.mean()
    assert_equal_sums(found, expected)


def assert_equal_sums(found, expected, rounding=0.0):
    """Counts are equal, means over the pixels of a segment to rounding, besides that of the distances, in standard
    deviations; the first entry is meaningless."""
    size = np.maximum(expected.pixels[1:], 1)
    for name, numbers, values in zip(found._fields, found, expected, strict=True):
        assert values[1:].any()
        exact = name in ("pixels", "compared", "moving", "static")
        limit = 0 if exact else 3e-6 + (rounding if name == "distance" else 0)
        np.testing.assert_allclose(numbers[1:] / size, values[1:] / size, atol=limit, err_msg=name)


@pytest.mark.parametrize("window", [3, 5])
def test_sums_of_older_frames_are_those_of_the_cpu(cpu, gpu, frame, smooth, older, window):
    labels, count = cpu.segment_surface(smooth, CAMERA.intrinsics, tolerances(smooth), *SEGMENTS)
    shade, gradient = (np.random.default_rng(n).random(SHAPE).astype(np.float32) for n in (1, 2))
    segments = SegmentImage(labels, count, frame[1], gradient, window)
    arguments = smooth, shade, CAMERA.intrinsics, older[1], segments, 4
    expected, found = (backend.compare_with_frame(*arguments) for backend in (cpu, gpu))
    assert_equal_sums(found, expected, float(np.spacing(smooth.max()) / frame[1][smooth > 0].min()))


def test_no_image_comes_down_before_the_probabilities(gpu, frame, smooth, older, monkeypatch):
    fetched = []

    def download(self, array, fetch):
        fetched.append(array.shape)
        return fetch(self, array)

    for owner in (HostQueue, Staging):
        monkeypatch.setattr(owner, "download", partialmethod(download, fetch=owner.download))
    noise, tolerance = np.full(SHAPE, 0.02, np.float32), tolerances(smooth)
    gpu.residual_counts(frame[0], smooth, frame[1])
    free = gpu.free_space(smooth, smooth, CAMERA.intrinsics, noise, older, 3)
    odds = gpu.log_odds(frame[0], frame[1], PARAMETERS, True, free)
    gpu.label(odds, smooth, tolerance, 4.0, 4)
    assert fetched == [(BINS + 2,), SHAPE]
    assert np.asarray(free).shape == np.asarray(odds).shape == SHAPE


def test_the_cpu_computes_what_a_lost_device_had(cpu, frame, smooth, older, monkeypatch):
    """The images that the host had not read are computed anew, each from the one before."""
    device, told = Device(monkeypatch), []
    backend, noise = make_backend("warp-cpu"), np.full(SHAPE, 0.02, np.float32)
    tolerance = tolerances(smooth)
    with faults.told_to(told.append):
        free = backend.free_space(smooth, smooth, CAMERA.intrinsics, noise, older, 3)
        odds = backend.log_odds(frame[0], frame[1], PARAMETERS, True, free)
        device.breaks(LOST)
        found = backend.label(odds, smooth, tolerance, 4.0, 4)
    faults.forget()
    seen_free = cpu.free_space(smooth, smooth, CAMERA.intrinsics, noise, older, 3)
    expected = cpu.label(cpu.log_odds(frame[0], frame[1], PARAMETERS, True, seen_free), smooth, tolerance, 4.0, 4)
    np.testing.assert_array_equal(found, expected)
    assert len(told) == 1


@pytest.mark.parametrize(
    "kernel",
    ["count_residuals", "count_views", "log_odds", "mean_field_sweep", "join", "marked_within", "add_segments"],
)
def test_the_cpu_does_what_has_too_little_memory(gpu, frame, smooth, older, monkeypatch, kernel):
    """Whatever step fails, what follows takes the CPU's result, and what came before is read."""
    expected, device, told = labelled(gpu, frame, smooth, older), Device(monkeypatch), []
    with faults.told_to(told.append):
        device.breaks(FULL, kernel)
        found = labelled(gpu, frame, smooth, older)
    assert 1 <= len(told) <= 2  # segments and regions are joined by the same kernel
    assert all("too little free memory for the operation" in sentence for sentence in told)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), atol=0.02, rtol=1e-3)
