"""The distortion of a depth camera, estimated from a corner of three walls that it sees from many sides."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.core.calibration.depth_estimator import DepthView, estimate_distortion
from dudmap.core.calibration.depth_model import TERMS, DepthModel, image_extent, terms
from dudmap.core.geometry import se3
from dudmap.errors import DatasetError
from textured_corner import CAMERA, SENSOR, corner

TRUTH = {(0, 2, 1): 0.010, (0, 3, 0): -0.006, (0, 0, 2): 0.008, (1, 1, 1): 0.004}
"""Coefficients of the distortion, 1/m and 1/m^2: about 1 % at the depth of the walls."""
EXTENT = image_extent(CAMERA)
RAYS = CAMERA.backproject(np.ones(CAMERA.shape, np.float32)).reshape(-1, 3)[:, :2].astype(np.float64)


def pose(number: int) -> np.ndarray:
    """The camera moves 20 cm and turns 17 degrees to every side, at three frequencies."""
    a, b, c = np.sin(0.42 * number), np.sin(0.68 * number + 1), np.sin(0.26 * number + 2)
    return np.array([0.2 * a, 0.15 * b, 0.1 * c, 0.2 * b, 0.2 * c, 0.3 * a])


def views(truth: dict, count: int = 24, still: bool = False, noise: float = 0.001) -> list[DepthView]:
    """Views whose inverse depth is too small by the terms of ``truth``, at poses that are 3 mm and 0.2 degrees off."""
    rng = np.random.default_rng(2)
    state = np.array([truth.get(term, 0.0) for term in TERMS])
    out = []
    for number in range(count):
        twist = pose(0 if still else number)
        exact = corner(twist).depth.astype(np.float64).ravel()
        read = exact.copy()
        for _ in range(20):  # the terms take the depth that was read
            read = 1 / (1 / exact - terms(RAYS, read, EXTENT) @ state)
        read += noise * read**2 * rng.standard_normal(read.shape)
        depth = read.reshape(CAMERA.shape).astype(np.float32)
        wrong = se3.exp(rng.standard_normal(6) * [0.003, 0.003, 0.003, 0.003, 0.003, 0.003])
        out.append(DepthView.of(depth, CAMERA, se3.exp(twist) @ wrong))
    return out


@pytest.fixture(scope="module")
def found() -> DepthModel:
    return estimate_distortion(views(TRUTH), CAMERA, SENSOR)


def left(model: DepthModel) -> float:
    """Root mean square of what a model leaves of the true distortion at the depths of the corner, over its own."""
    truth = np.array([TRUTH.get(term, 0.0) for term in TERMS])
    errors, own = [], []
    for number in range(0, 24, 6):
        basis = terms(RAYS, corner(pose(number)).depth.astype(np.float64).ravel(), EXTENT)
        errors.append(basis @ (model.state - truth))
        own.append(basis @ truth)
    return float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(own))))


def test_most_of_a_distortion_is_recovered(found):
    assert left(found) < 0.4


def test_the_correction_is_the_significant_part_of_the_state(found):
    """The polynomial in powers of x and y is that of the terms."""
    exact = replace(found, covariance=np.zeros_like(found.covariance))
    depth = corner(pose(3)).depth
    basis = terms(RAYS, depth.astype(np.float64).ravel(), EXTENT)
    expected = 1 / (1 / depth.astype(np.float64).ravel() + basis @ found.state)
    assert exact.correction.depth(depth, CAMERA).ravel() == pytest.approx(expected, rel=1e-5)
    unknown = replace(found, covariance=np.eye(len(TERMS)))
    assert not unknown.correction.coefficients.any()


def test_an_exact_sensor_is_hardly_changed():
    model = estimate_distortion(views({}), CAMERA, SENSOR)
    constant, _ = model.correction.change(CAMERA)
    assert np.sqrt(np.mean(constant**2)) < 0.001  # 0.2 % at 2 m


def test_a_camera_at_rest_learns_nothing():
    model = estimate_distortion(views(TRUTH, count=6, still=True), CAMERA, SENSOR)
    assert model.views == 0
    assert not model.correction.coefficients.any()


def test_a_model_is_read_as_it_was_written(found, tmp_path):
    found.save(tmp_path / "model.npz")
    again = DepthModel.load(tmp_path / "model.npz")
    assert np.array_equal(again.state, found.state)
    assert np.array_equal(again.correction.coefficients, found.correction.coefficients)
    assert again.views == found.views


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"nothing")
    for name in ("model.npz", "missing.npz"):
        with pytest.raises(DatasetError, match="not a readable depth model"):
            DepthModel.load(tmp_path / name)
