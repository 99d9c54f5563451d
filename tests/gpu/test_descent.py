"""The loop of the registration on the device: the steps of the host's loop, and of plain linear algebra."""

import numpy as np
import pytest

from dudmap.gpu.device import make_backend

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from failing import FULL, LOST, Device

from dudmap.config import Config, TrackerConfig
from dudmap.frames.preprocess import Preprocessor
from dudmap.frames.pyramid import Pyramid
from dudmap.geometry import se3
from dudmap.gpu import descent, faults
from dudmap.gpu.backend import WarpBackend
from dudmap.gpu.kernels import descent as kernels
from dudmap.gpu.kernels.formulas import Motion
from dudmap.kernels.damping import tightened
from dudmap.kernels.registration import SYMMETRIC
from dudmap.tracking import tracker as tracking
from dudmap.tracking.observability import COMPLETE, Observability
from dudmap.tracking.tracker import Tracker
from small_maps import CAMERA, integrated

LEVELS = "tracker.widths=[40,80,160]"


@pytest.fixture(scope="module")
def volume(recording):
    return integrated(recording, "warp-cpu")


def tracker_of(*assignments):
    config = Config().override([LEVELS, *assignments])
    return Tracker(config.tracker, config.sensor)


def levels_of(recording, index):
    config = Config().override([LEVELS])
    return Pyramid.of(Preprocessor(CAMERA, config.preprocess)(recording[index]), CAMERA, config).tracked


def by_the_host(monkeypatch, action):
    with monkeypatch.context() as patch:
        patch.setattr(WarpBackend, "descend", lambda self, *arguments: None)
        return action()


@pytest.mark.parametrize(
    ("assignments", "twist"),
    [
        ((), [0.01, -0.005, 0.008, 0.004, -0.006, 0.003]),
        (("tracker.robust=tukey",), [-0.01, 0.01, 0.0, 0.01, 0.0, 0.0]),
        (("tracker.iterations=[2,0,1]",), [0.02, 0.0, -0.02, 0.0, 0.02, 0.0]),
        (("tracker.stop_gain=0", "tracker.iterations=[30,30,30]"), [0.01, 0.0, 0.01, 0.0, 0.0, 0.01]),
        (("tracker.damping=1e-6", "tracker.color_weight=0"), [0.25, -0.2, 0.2, 0.15, -0.1, 0.1]),  # steps are rejected
    ],
    ids=str,
)
def test_the_steps_are_those_of_the_host(volume, recording, monkeypatch, assignments, twist):
    """Sums of one pose are equal to the bit; the poses differ by roundings of float64, one in some 1e15."""
    tracker, levels = tracker_of(*assignments), levels_of(recording, 4)
    T = se3.exp(np.array(twist)) @ recording.ground_truth.Ts_world_camera[4]
    rejected = []
    monkeypatch.setattr(tracking, "tightened", lambda damping: rejected.append(damping) or tightened(damping))
    found = tracker.align(volume, levels, T)
    assert not rejected  # the host has no part in it
    expected = by_the_host(monkeypatch, lambda: tracker.align(volume, levels, T))
    assert rejected or "tracker.damping=1e-6" not in assignments
    assert found.iterations == expected.iterations
    assert found.settled == expected.settled
    assert found.reason == expected.reason
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-9)
    for name in ("inlier_share", "residual", "condition", "color_residual"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6)


@pytest.mark.parametrize("dimensions", [0, 1, 3, 5])
def test_the_pose_stays_where_the_view_determines_nothing(volume, recording, monkeypatch, dimensions):
    tracker, level = tracker_of(), levels_of(recording, 4)[-1]
    basis = np.linalg.qr(np.random.default_rng(dimensions).normal(size=(6, 6)))[0]
    seen = Observability(basis[:, :dimensions], basis[:, dimensions:].T)
    T = se3.exp(np.array([0.01, -0.005, 0.008, 0.004, -0.006, 0.003])) @ recording.ground_truth.Ts_world_camera[4]
    weights = np.ones_like(level.depth)
    volume.look_at(T)
    system = tracker.linearize(volume, level, T, weights)

    def optimized():
        return tracker._optimize(volume, level, T, weights, system, 6, 1e-4, None, seen)

    found, expected = optimized(), by_the_host(monkeypatch, optimized)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-9)
    assert found[2:] == expected[2:]
    if dimensions == 0:
        assert found[1] is system  # the first equations are those of the result
        np.testing.assert_array_equal(found[0], T)
    for number in range(2):
        np.testing.assert_allclose(found[1].residuals[number], expected[1].residuals[number], atol=1e-6)


def test_residuals_stay_those_of_their_steps(volume, recording):
    """Later steps write to other memory."""
    tracker, level, weights = tracker_of(), levels_of(recording, 4)[-1], np.ones((120, 160), np.float32)
    results = []
    for index in (3, 4):
        T = recording.ground_truth.Ts_world_camera[index]
        volume.look_at(T)
        system = tracker.linearize(volume, level, T, weights)
        results.append(tracker._optimize(volume, level, T, weights, system, 6, 1e-4, None, COMPLETE)[:2])
    for T, system in results:
        again = tracker.linearize(volume, level, T, weights)
        assert again.cost == pytest.approx(system.cost, rel=0.01)
        difference = np.abs(again.residuals[0] - system.residuals[0])
        assert np.nanmedian(difference) < 1e-3
    assert np.nanmedian(np.abs(results[0][1].residuals[0] - results[1][1].residuals[0])) > 1e-4


def advanced(H, b, basis, damping):
    """State after the first proposal."""
    state = np.zeros(kernels.STATE_SIZE)

    def part(name):
        return state[kernels.PLACES[name] :][: kernels.SIZES[name]]

    part("POSE")[:] = np.eye(4)[:3].reshape(-1)
    part("SUMS")[SYMMETRIC] = H
    part("SUMS")[21:27] = b
    part("BASIS").reshape(6, 6)[:, : basis.shape[1]] = basis
    for name, value in (("DIMENSIONS", basis.shape[1]), ("VOXEL", 1), ("DAMPING", damping), ("LIMIT", 1)):
        part(name)[:] = value
    part("STATUS")[:] = kernels.RUNNING
    array, motion = wp.array(state, device="cpu"), wp.zeros(1, dtype=Motion, device="cpu")
    wp.launch(kernels.advance, dim=1, inputs=[1, array, motion], device="cpu")
    state[:] = array.numpy()
    return part("STEP").copy(), part("TRIAL").reshape(3, 4).copy(), part("STATUS")[0], motion.numpy().reshape(3, 4)


@pytest.mark.parametrize("seed", range(20))
def test_a_step_solves_the_damped_equations(seed):
    random = np.random.default_rng(seed)
    J = random.normal(size=(40, 6)) * 10.0 ** random.uniform(-3, 3, 6)
    H, b, damping = J.T @ J, J.T @ random.normal(size=40), 10.0 ** random.uniform(-6, 1)
    basis = np.linalg.qr(random.normal(size=(6, 6)))[0][:, : random.integers(1, 7)]
    damped = H + np.diag(damping * np.diag(H) + 1e-9 * np.diag(H).max())
    step, trial, status, motion = advanced(H, b, basis, damping)
    expected = basis @ np.linalg.solve(basis.T @ damped @ basis, -basis.T @ b)
    assert status == kernels.RUNNING
    np.testing.assert_allclose(step, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(trial, se3.retract(np.eye(4), step)[:3], atol=1e-12)
    np.testing.assert_array_equal(motion, trial.astype(np.float32))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-4, 1.01e-4, 0.3, 3.0, 100.0])
def test_a_rotation_is_that_of_the_host(angle):
    rotation = angle * np.array([0.6, -0.48, 0.64])
    H, b = np.eye(6), -np.concatenate([np.zeros(3), rotation])
    step, trial, _, _ = advanced(H, b, np.eye(6), 0.0)
    np.testing.assert_allclose(trial[:, :3], se3.exp_rotation(step[3:]), atol=1e-15)
    np.testing.assert_allclose(trial[:, :3] @ trial[:, :3].T, np.eye(3), atol=1e-14)


def test_equations_without_a_solution_are_left_to_the_host():
    twice = np.eye(6)[:, [0, 1, 1]]  # one direction twice
    assert advanced(np.eye(6), np.ones(6), twice, 0.1)[2] == kernels.INDEFINITE
    assert advanced(np.diag([1.0, 1, 1, 1, 1, -1]), np.ones(6), np.eye(6), 0.1)[2] == kernels.INDEFINITE
    assert advanced(np.zeros((6, 6)), np.ones(6), np.eye(6), 0.1)[2] == kernels.EXHAUSTED
    assert advanced(np.eye(6), np.full(6, np.nan), np.eye(6), 0.1)[2] == kernels.INDEFINITE


def test_the_host_makes_the_steps_that_the_device_does_not(volume, recording, monkeypatch):
    tracker, levels = tracker_of(), levels_of(recording, 4)
    T = recording.ground_truth.Ts_world_camera[3]
    expected = by_the_host(monkeypatch, lambda: tracker.align(volume, levels, T))
    states = []

    def left(state, name, part=descent._part):
        if name != "STATUS":
            return part(state, name)
        states.append(state)
        return part(state, name) if len(states) % 2 else np.array([kernels.INDEFINITE])  # read every second time

    monkeypatch.setattr(descent, "_part", left)
    found = tracker.align(volume, levels, T)
    assert len(states) == 6
    np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
    assert found.iterations == expected.iterations


@pytest.mark.parametrize("error", [LOST, FULL])
def test_the_host_goes_on_where_the_device_fails(recording, monkeypatch, error):
    """The steps of the CPU begin with the equations that the device found, and end where the device would."""
    volume, tracker, levels = integrated(recording, "warp-cpu"), tracker_of(), levels_of(recording, 4)
    T = recording.ground_truth.Ts_world_camera[3]
    expected = tracker.align(volume, levels, T)
    _ = volume.blocks.geometry, volume.blocks.colors
    device, told = Device(monkeypatch), []
    with faults.told_to(told.append):
        device.breaks(error, only="linearize_trial")
        found = tracker.align(volume, levels, T)
    faults.forget()
    assert found.converged
    assert np.linalg.norm((found.T_world_camera - expected.T_world_camera)[:3, 3]) < 1e-3
    assert len(told) == 1


def test_residuals_that_are_lost_are_computed_anew(recording, monkeypatch):
    volume, tracker, level = integrated(recording, "warp-cpu"), tracker_of(), levels_of(recording, 4)[-1]
    T, weights = recording.ground_truth.Ts_world_camera[3], np.ones((120, 160), np.float32)
    volume.look_at(T)
    system = tracker.linearize(volume, level, T, weights)
    arguments = volume, level, T, weights, system, 6, True, None, COMPLETE
    expected, (_, found, _, _) = (tracker._optimize(*arguments) for _ in range(2))
    expected = expected[1].residuals[0]
    _ = volume.blocks.geometry, volume.blocks.colors
    device = Device(monkeypatch)
    with faults.told_to(lambda sentence: None):
        device.breaks()
        residual = found.residuals[0]
    faults.forget()
    assert (np.isnan(residual) != np.isnan(expected)).mean() < 1e-2
    # the last step, a twist shorter than the tolerance, is made without a linearisation
    longest = TrackerConfig().stop * (1 + 1.5 * level.depth.max())
    np.testing.assert_allclose(np.nan_to_num(residual - expected), 0, atol=longest)


def test_the_host_rotates_by_the_same_elements():
    """Against Rodrigues' formula with matrices."""
    for seed in range(20):
        omega = np.random.default_rng(seed).normal(size=3) * 10.0 ** np.random.default_rng(seed).uniform(-6, 0.5)
        np.testing.assert_allclose(
            se3.exp_rotation(omega), se3.exp(np.concatenate([np.zeros(3), omega]))[:3, :3], atol=1e-14
        )
