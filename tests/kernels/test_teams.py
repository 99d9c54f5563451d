"""Bands that threads share inside a compiled call, and the descent that is one."""

import numpy as np
import pytest

from dudmap import Config
from dudmap.core.backends.cpu.backend import CpuBackend
from dudmap.core.backends.cpu.registration import write_lattice
from dudmap.core.backends.cpu.teams import NO_BAND, announce, done, finish, run_team, take, wait_for_all, wait_for_work
from dudmap.core.backends.descent import descend
from dudmap.core.backends.parameters import LevelImage, to_lattice
from dudmap.core.backends.threads import kernel
from dudmap.core.frames.observation import Pyramid
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.tracker import Tracker
from wavy_wall import CAMERA, wall

BANDS, STEPS = 7, 200


@kernel
def count_visits(leads, team, visits):
    """Count how often each band (column) of each step (row) is worked on."""
    if not leads:
        band, step = wait_for_work(team, visits.shape[1])
        while band != NO_BAND:
            visits[step, band] += 1
            done(team)
            band, step = wait_for_work(team, visits.shape[1])
        return
    for number in range(len(visits)):
        announce(team, number)
        band, step = take(team, visits.shape[1])
        while band != NO_BAND:
            visits[step, band] += 1
            done(team)
            band, step = take(team, visits.shape[1])
        wait_for_all(team, visits.shape[1])
        for n in range(visits.shape[1]):
            visits[number, n] *= 10  # what others wrote is visible here
    finish(team)


@pytest.fixture(params=["1", "2", "4"])
def num_threads(request, give_threads):
    give_threads(int(request.param))
    return int(request.param)


def test_each_band_of_each_step_is_done_once(num_threads):
    for _ in range(20):
        visits = np.zeros((STEPS, BANDS), dtype=np.int64)
        run_team(count_visits, BANDS, visits)
        assert (visits == 10).all()


def registration():
    """A map of a wall, an image of it from elsewhere, and what ``register`` takes."""
    config = Config().override(["volume.voxel_size=0.05", "volume.truncation_noise=0"])
    backend = CpuBackend()
    volume = TsdfVolume(CAMERA, config.volume, config.sensor, backend=backend)
    observation = Preprocessor(CAMERA, config.preprocess)(wall(2.0))
    volume.integrate(wall(2.0), np.eye(4))
    level = Pyramid.of(observation, CAMERA, config).fine
    tracker = Tracker(config.tracker, config.sensor)
    T = se3.exp(np.array([0.01, -0.008, 0.012, 0.004, 0.006, -0.003]))
    volume.look_at(T)
    weights = np.ones_like(level.depth)
    return volume, tracker, level, weights, T


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("columns", [6, 4])
def test_the_compiled_descent_is_the_loop_of_the_text(num_threads, known, columns, monkeypatch):
    monkeypatch.setattr("dudmap.core.backends.cpu.backend.PIXELS_PER_BAND", 256)  # several bands
    volume, tracker, level, weights, T = registration()
    rules = tracker._rules(8, finest=False)._replace(basis=np.eye(6)[:, :columns].copy())
    first = tracker.linearize(volume, level, T, weights) if known else None
    parameters = tracker.parameters(volume.band)
    image = LevelImage(level.depth, level.intensity, weights, level.camera.intrinsics)
    found = volume.backend.register(volume.grid, image, T, first, rules, parameters)
    expected = descend(lambda at: tracker.linearize(volume, level, at, weights), T, first, rules)
    assert found.iterations == expected.iterations > 2
    assert found.converged == expected.converged
    assert np.abs(found.T_world_camera - T).max() > 1e-3
    # both are compiled on their own: sums of float32 numbers are rounded in another order
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(found.equations.H, expected.equations.H, atol=1e-4 * np.abs(expected.equations.H).max())
    np.testing.assert_allclose(found.equations.residuals, expected.equations.residuals, atol=1e-4)
    again = volume.backend.register(volume.grid, image, T, first, rules, parameters)
    np.testing.assert_array_equal(found.T_world_camera, again.T_world_camera)


def test_a_pose_is_written_in_the_lattice():
    T, origin, out = np.arange(16.0).reshape(4, 4) / 7, np.array([3, -20, 8]), np.empty((3, 4), np.float32)
    write_lattice(T, 0.01, origin, out)
    np.testing.assert_allclose(out, to_lattice(T, 0.01, origin), rtol=1e-6)
