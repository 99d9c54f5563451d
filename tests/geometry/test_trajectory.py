"""Trajectory text and interpolation."""

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError


def path(count: int = 5) -> Trajectory:
    return Trajectory.from_poses(
        (100 + 0.1 * n, se3.exp(np.array([0.1 * n, 0.0, 0.02 * n, 0.0, 0.05 * n, 0.3]))) for n in range(count)
    )


def test_text_round_trip(tmp_path):
    path().save(tmp_path / "trajectory.txt")
    loaded = Trajectory.load(tmp_path / "trajectory.txt")
    assert np.allclose(loaded.timestamps, path().timestamps, atol=1e-6)
    assert np.allclose(loaded.Ts_world_camera, path().Ts_world_camera, atol=1e-8)


def test_interpolation_lies_on_the_screw_between_neighbours():
    T = path().interpolate(100.15)
    a, b = path().Ts_world_camera[1:3]
    assert np.allclose(se3.log(se3.inverse(a) @ T) * 2, se3.log(se3.inverse(a) @ b), atol=1e-9)
    assert np.allclose(path().interpolate(100.2), path().Ts_world_camera[2])
    with pytest.raises(DatasetError, match="outside"):
        path().interpolate(99.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "lists nothing"),
        ("# only a comment\n", "lists nothing"),
        ("1 2 3\n", "line 1"),
        ("0 0 0 0 0 0 0 1\n1 0 0 nan 0 0 0 1\n", "line 2"),
        ("0 0 0 0 0 0 0 0\n", "non-zero quaternion"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "not strictly increasing"),
        ("hello\n", "expected .timestamp tx ty tz"),
    ],
)
def test_bad_text_is_refused_with_a_sentence(tmp_path, text, says):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(DatasetError, match=says):
        Trajectory.load(tmp_path / "bad.txt")


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="cannot read"):
        Trajectory.load(tmp_path / "none.txt")


def test_poses_after_those_of_the_stamps_lie_on_the_way_of_a_steady_camera():
    stamps = np.array([0.0, 0.03, 0.07, 0.10, 0.60, 0.63])
    twist = np.array([0.5, -0.2, 0.1, 0.3, 0.8, -0.4])
    trajectory = Trajectory(stamps, se3.exp_all(stamps[:, None] * twist))
    for seconds in (0.018, -0.018):
        wanted = se3.exp_all((stamps + seconds)[:, None] * twist)
        np.testing.assert_allclose(trajectory.after(seconds).Ts_world_camera, wanted, atol=1e-12)
    np.testing.assert_array_equal(trajectory.after(0.0).Ts_world_camera, trajectory.Ts_world_camera)
    each = np.array([0.0, 0.018, -0.018, 0.018, -0.018, 0.0])
    wanted = se3.exp_all((stamps + each)[:, None] * twist)
    np.testing.assert_allclose(trajectory.after(each).Ts_world_camera, wanted, atol=1e-12)
    alone = Trajectory(np.array([0.0, 1.0]), trajectory.Ts_world_camera[:2])
    np.testing.assert_array_equal(alone.after(0.02).Ts_world_camera, alone.Ts_world_camera)
