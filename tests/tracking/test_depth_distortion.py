"""The distortion of a depth camera, learnt from a corner of three walls that it sees from many sides."""

import numpy as np
import pytest

from dudmap.config import TrackerConfig, VolumeConfig
from dudmap.errors import DatasetError
from dudmap.frames.depth_correction import DepthCorrection
from dudmap.frames.frame import Frame
from dudmap.frames.observation import Level
from dudmap.geometry import se3
from dudmap.mapping.volume import TsdfVolume
from dudmap.tracking.depth_distortion import HALF_WIDTH, TERMS, DepthDistortion
from dudmap.tracking.tracker import Tracker
from textured_corner import CAMERA, SENSOR, corner, level_of, ones

X = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
Y = ((np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy)[:, None]
TRUTH = {(2, 1): 0.06, (3, 0): -0.04, (0, 2): 0.03}
"""Coefficients of the distortion, 1/m: 1 to 2 % at the edge of the image."""


def twist(number: int) -> np.ndarray:
    """The camera moves 20 cm and turns 12 degrees to every side, at three frequencies."""
    a, b, c = np.sin(0.42 * number), np.sin(0.68 * number + 1), np.sin(0.26 * number + 2)
    return np.array([0.2 * a, 0.15 * b, 0.1 * c, 0.2 * b, 0.2 * c, 0.3 * a])


def learnt(truth: dict, still: bool = False, known: DepthDistortion | None = None, noise: float = 0.001):
    """What is learnt from 30 frames with known poses, whose inverse depth is too small by the terms of ``truth``."""
    tracker, found, rng = Tracker(TrackerConfig(), SENSOR), known or DepthDistortion(), np.random.default_rng(2)
    applied = found.correction
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02), SENSOR, depth_max=4.0)
    error = sum((c * X**i * Y**j for (i, j), c in truth.items()), np.zeros((60, 80)))
    for number in range(30):
        xi = twist(0 if still else number)
        frame = corner(xi)
        depth = (1 / (1 / frame.depth.astype(np.float64) - error)).astype(np.float32)
        depth += (noise * depth**2 * rng.standard_normal(depth.shape)).astype(np.float32)
        depth = applied.depth(depth, CAMERA)
        level = Level(CAMERA, depth, level_of(frame).intensity)
        volume.look_at(se3.exp(xi))
        if number:
            found.update(tracker, volume, level, se3.exp(xi), ones(level), applied)
        volume.integrate(Frame(float(number), depth, frame.color), se3.exp(xi))
    return found


@pytest.fixture(scope="module")
def found() -> DepthDistortion:
    return learnt(TRUTH)


def test_a_distortion_is_recovered(found):
    expected = np.array([TRUTH.get(term, 0.0) * HALF_WIDTH ** sum(term) for term in TERMS])
    assert np.abs(found.state - expected).max() < 0.35 * np.abs(expected).max()
    assert np.all(np.abs(found.state - expected) < 4 * found.sigma)
    truth = DepthCorrection()
    for (i, j), value in TRUTH.items():
        truth.coefficients[i, j] = value
    left = found.correction.change(CAMERA) - truth.change(CAMERA)
    plane = np.stack([np.ones(4800), np.tile(X, 60), np.repeat(Y[:, 0], 80)], axis=1)

    def bent(change: np.ndarray) -> float:
        """Root mean square without what a rigid motion imitates."""
        return float((change.ravel() - plane @ np.linalg.lstsq(plane, change.ravel(), rcond=None)[0]).std())

    assert bent(left) < 0.5 * bent(truth.change(CAMERA))


def test_an_exact_sensor_stays_as_it_is():
    assert not learnt({}).correction.coefficients.any()


def test_a_camera_at_rest_learns_nothing():
    found, untouched = learnt(TRUTH, still=True), DepthDistortion()
    assert not found.correction.coefficients.any()
    assert found.sigma == pytest.approx(untouched.sigma, rel=0.02)


def test_a_known_distortion_is_removed_and_confirmed(found, tmp_path):
    found.save(tmp_path / "model.npz")
    known = DepthDistortion.load(tmp_path / "model.npz")
    assert np.array_equal(known.state, found.state)
    assert np.array_equal(known.correction.coefficients, found.correction.coefficients)
    again = learnt(TRUTH, known=known)
    assert np.all(np.abs(again.state - found.state) < 4 * found.sigma)
    assert np.all(again.sigma <= found.sigma)


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"nothing")
    for name in ("model.npz", "missing.npz"):
        with pytest.raises(DatasetError, match="not a readable depth model"):
            DepthDistortion.load(tmp_path / name)
