"""The registration against plain NumPy and against numerical derivatives; the tracker's checks."""

from collections.abc import Callable

import numpy as np
import pytest

from dudmap.config import Config, TrackerConfig, VolumeConfig
from dudmap.core.backends.cpu.exposure import fit_exposure
from dudmap.core.backends.descent import DescentRules, descend
from dudmap.core.backends.parameters import NormalEquations
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.observation import Level, chained, exposed
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import retract
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.tracking.checks import RELATIVE, RegistrationRules, judged
from dudmap.core.tracking.motion_model import MotionModel
from dudmap.core.tracking.quality_monitor import QualityMonitor
from dudmap.core.tracking.tracker import Tracker, TrackingResult
from dudmap.core.verdict import ACCEPTED
from textured_corner import CAMERA, SENSOR, corner, corner_map, level_of, ones


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    return corner_map()


def interior(tracker: Tracker, volume: TsdfVolume, level: Level, T: np.ndarray, reach: float) -> np.ndarray:
    """Weights of the pixels that stay on the map for all small steps."""
    valid = np.isfinite(tracker.linearize(volume, level, T, ones(level)).residuals[1])
    for axis in range(6):
        for sign in (-1, 1):
            T_near = retract(T, sign * reach * np.eye(6)[axis])
            valid &= np.isfinite(tracker.linearize(volume, level, T_near, ones(level)).residuals[1])
    return valid.astype(np.float32)


def test_the_gradient_is_that_of_the_cost(volume):
    tracker, level = Tracker(TrackerConfig(huber=0.02, color_weight=0.3), SENSOR), level_of(corner())
    T = retract(np.eye(4), np.array([0.006, -0.004, 0.005, 0.004, 0.003, -0.004]))
    step = 5e-5
    weights = interior(tracker, volume, level, T, 2 * step)
    assert weights.mean() > 0.5
    b = tracker.linearize(volume, level, T, weights).b
    numerical = np.zeros(6)
    for axis in range(6):
        ahead = tracker.linearize(volume, level, retract(T, step * np.eye(6)[axis]), weights).cost
        back = tracker.linearize(volume, level, retract(T, -step * np.eye(6)[axis]), weights).cost
        numerical[axis] = (ahead - back) / (2 * step)
    assert np.linalg.norm(b - numerical) < 0.05 * np.linalg.norm(numerical)


def test_normal_equations_equal_a_plain_sum_over_pixels(volume, monkeypatch):
    """H and b rebuilt from numerically differentiated residuals of every pixel, with quadratic cost."""
    monkeypatch.setattr("dudmap.core.tracking.tracker.COLOR_HUBER", 10.0)
    config = TrackerConfig(huber=10.0, color_weight=0.3)
    tracker, level = Tracker(config, SENSOR), level_of(corner())
    T = retract(np.eye(4), np.array([0.003, 0.002, -0.004, 0.002, -0.001, 0.003]))
    step = 1e-4
    weights = interior(tracker, volume, level, T, 2 * step)
    system = tracker.linearize(volume, level, T, weights)
    r = system.residuals[:, weights > 0].astype(np.float64)
    J = np.empty((*r.shape, 6))
    for axis in range(6):
        ahead = tracker.linearize(volume, level, retract(T, step * np.eye(6)[axis]), weights).residuals[:, weights > 0]
        back = tracker.linearize(volume, level, retract(T, -step * np.eye(6)[axis]), weights).residuals[:, weights > 0]
        J[..., axis] = (ahead.astype(np.float64) - back) / (2 * step)
    noise = np.minimum(SENSOR.sigma(1.0) / SENSOR.sigma(level.depth[weights > 0]), 1)
    scale = np.stack([noise**2, np.full_like(noise, 0.3)])
    H = np.einsum("cn,cni,cnj->ij", scale, J, J)
    b = np.einsum("cn,cni,cn->i", scale, J, r)
    assert np.abs(system.H - H).max() < 0.05 * np.abs(H).max()
    assert np.abs(system.b - b).max() < 0.05 * np.abs(b).max()
    assert np.allclose(system.H, system.H.T)


def test_alignment_finds_a_known_motion(volume):
    tracker = Tracker(TrackerConfig(widths=(40, 80), iterations=(10, 10)), SENSOR)
    xi = np.array([0.02, -0.015, 0.01, 0.01, -0.012, 0.015])
    frame = corner(xi)
    every_second = slice(None, None, 2)
    coarse = Level(
        Camera(40.0, 40.0, 19.75, 14.75, 40, 30),
        np.ascontiguousarray(frame.depth[every_second, every_second]),
        np.ascontiguousarray(level_of(frame).intensity[every_second, every_second]),
    )
    result = tracker.align(volume, [coarse, level_of(frame)], np.eye(4))
    error = se3.inverse(se3.exp(xi)) @ result.T_world_camera
    assert result.accepted
    assert np.linalg.norm(error[:3, 3]) < 0.003
    assert np.degrees(se3.rotation_angle(error)) < 0.15


def test_a_coarse_level_that_gains_nothing_more_ends_there(volume, monkeypatch):
    """Noise makes steps that lead nowhere; poses found in fewer of them are as good."""
    xi = np.array([0.004, -0.003, 0.002, 0.002, -0.003, 0.003])
    monkeypatch.setattr("dudmap.core.tracking.tracker.STOP_COARSE", 2e-4)
    found: dict[float, list[TrackingResult]] = {0.0: [], 3e-3: []}
    for seed in range(8):
        rng, level = np.random.default_rng(seed), level_of(corner(xi))
        depth = level.depth + rng.normal(0, 0.01, level.depth.shape)
        intensity = level.intensity + rng.normal(0, 0.1, level.depth.shape)
        noisy = Level(CAMERA, depth.astype(np.float32), intensity.astype(np.float32))
        for stop_gain, results in found.items():
            monkeypatch.setattr("dudmap.core.tracking.tracker.STOP_GAIN", stop_gain)
            # of two levels, of which the first is given
            config = TrackerConfig(widths=(80, 160), iterations=(30, 30), exposure=False)
            results.append(Tracker(config, SENSOR).align(volume, [noisy], np.eye(4)))
    iterations = {gain: sum(result.iterations for result in results) for gain, results in found.items()}
    errors = {
        gain: np.mean([np.linalg.norm(result.T_world_camera[:3, 3] - se3.exp(xi)[:3, 3]) for result in results])
        for gain, results in found.items()
    }
    assert iterations[3e-3] < iterations[0.0]
    assert errors[3e-3] < errors[0.0] + 0.0005


def robust_line(shrink: float, jump: float) -> Callable[[np.ndarray], NormalEquations]:
    """Normal equations of a pose whose x is to be found, at ``GOAL``: of each step the share ``shrink`` is missing, and
    every new pose costs ``jump`` more."""
    costs = iter(jump * np.arange(100))

    def linearize(T: np.ndarray) -> NormalEquations:
        b = (1 - shrink) * np.array([T[0, 3] - GOAL, 0, 0, 0, 0, 0])
        return NormalEquations(np.eye(6), b, next(costs), 1, 1.0, 1.0, 0.0, np.empty((2, 1, 1), np.float32))

    return linearize


GOAL = 0.05
"""Distance, metres, of the pose that is sought in ``robust_line``."""
STEPS = DescentRules(np.eye(6), damping=0.0, max_steps=6, stop=1e-5, stop_gain=0.0)


def test_readings_that_enter_and_leave_the_map_do_not_decide_which_steps_are_taken():
    """They change the cost by more than a step does; its gradient knows nothing of them."""
    found = descend(robust_line(0.5, jump=1.0), np.eye(4), None, STEPS)
    assert abs(found.T_world_camera[0, 3] - GOAL) < 1e-4


@pytest.mark.parametrize("shrink", [0.6, 0.3, -0.3])
def test_steps_that_are_too_short_or_too_long_by_the_same_factor_are_added_up(shrink):
    found = descend(robust_line(shrink, jump=0.0), np.eye(4), None, STEPS)
    assert found.converged
    assert found.iterations <= 4, "a geometric sequence is known from two of its steps"
    assert abs(found.T_world_camera[0, 3] - GOAL) < 1e-4


def test_a_step_that_leads_up_is_not_taken():
    """Each goes 2.5 times too far."""
    found = descend(robust_line(-1.5, jump=-1.0), np.eye(4), None, STEPS._replace(max_steps=1))
    assert np.array_equal(found.T_world_camera, np.eye(4))


def test_pixels_of_weight_zero_have_no_say(volume):
    tracker, level = Tracker(TrackerConfig(), SENSOR), level_of(corner())
    weights = ones(level)
    weights[:, 40:] = 0
    spoiled = Level(CAMERA, level.depth.copy(), level.intensity.copy())
    spoiled.depth[:, 40:] -= 0.02
    a = tracker.linearize(volume, level, np.eye(4), weights)
    b = tracker.linearize(volume, spoiled, np.eye(4), weights)
    assert np.array_equal(a.H, b.H)
    assert a.cost == b.cost


def test_a_view_of_nothing_known_is_not_converged(volume):
    tracker = Tracker(TrackerConfig(widths=(80,), iterations=(5,)), SENSOR)
    away = np.eye(4)
    away[0, 3] = 30.0
    result = tracker.align(volume, [level_of(corner())], away)
    assert not result.accepted
    assert "fall on the map" in result.verdict.reason


def test_a_flat_wall_without_texture_is_degenerate():
    flat = Frame(0.0, np.full(CAMERA.shape, 1.5, np.float32), np.full((*CAMERA.shape, 3), 120, np.uint8))
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02, truncation_noise=0), SENSOR, depth_max=4.0)
    for _ in range(3):
        volume.integrate(flat, np.eye(4))
    result = Tracker(TrackerConfig(widths=(80,), iterations=(5,)), SENSOR).align(volume, [level_of(flat)], np.eye(4))
    assert result.accepted
    assert result.unobservable.shape == (3, 6)
    assert np.allclose(result.T_world_camera, np.eye(4), atol=1e-4)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.8, 0.1), (1.25, -0.08)])
def test_exposure_is_found_in_spite_of_outliers(gain, offset):
    rng = np.random.default_rng(5)
    intensity = rng.uniform(0.1, 0.9, (60, 80)).astype(np.float32)
    difference = (gain * intensity + offset - intensity + rng.normal(0, 0.01, intensity.shape)).astype(np.float32)
    difference[:15] = rng.uniform(-0.5, 0.5, (15, 80))
    difference[15] = np.nan
    found = fit_exposure(intensity, difference, np.ones_like(intensity))
    assert found[0] == pytest.approx(gain, abs=0.05)
    assert found[0] * 0.5 + found[1] == pytest.approx(gain * 0.5 + offset, abs=0.02)


def test_chained_exposures_apply_one_after_the_other():
    level = Level(CAMERA, np.ones((2, 2), np.float32), np.array([[0.1, 0.2], [0.3, 0.4]], np.float32))
    twice = exposed(exposed(level, (1.2, 0.1)), (0.9, -0.05))
    assert np.allclose(exposed(level, chained((1.2, 0.1), (0.9, -0.05))).intensity, twice.intensity)


def test_constant_velocity_goes_on_and_stops_some_time_after_a_loss():
    model = MotionModel(TrackerConfig())
    motion = se3.exp(np.array([0.01, 0.0, 0.02, 0.0, 0.01, 0.0]))
    model.update(0.0, np.eye(4))
    model.update(0.1, motion)
    assert np.allclose(model.predict(0.2), motion @ motion, atol=1e-9)
    assert np.allclose(model.predict(0.3), motion @ motion @ motion, atol=1e-9)
    model.lost(0.2)
    assert np.allclose(model.predict(0.2), motion @ motion, atol=1e-9)  # a single frame without a pose
    model.lost(0.3)
    assert np.allclose(model.predict(0.3), motion)
    view = Level(CAMERA, np.full((2, 2), 2.0, np.float32), np.zeros((2, 2), np.float32))
    leap = motion @ se3.exp(np.array([0.4, 0, 0, 0, 0, 0]))
    assert model.figures(0.2, leap, view)["speed_m_s"] == pytest.approx(4.0)
    model.timed = False  # 0.4 m at a depth of 2 m
    assert model.figures(0.2, leap, view)["step"] == pytest.approx(0.2 * CAMERA.fx / CAMERA.width)


def test_a_much_worse_registration_is_doubted():
    def result(residual: float, share: float = 0.9, color: float = 0.02) -> TrackingResult:
        return TrackingResult(np.eye(4), (1.0, 0.0), ACCEPTED, share, residual, 0.1, 3, color)

    monitor = QualityMonitor(Config(), MotionModel(TrackerConfig()))

    def doubt(tracking: TrackingResult) -> str:
        return judged(RELATIVE, tracking.figures, monitor.limits()).reason

    for _ in range(10):
        assert doubt(result(0.002)) == ""
        monitor.accept(result(0.002))
    assert doubt(result(0.004)) == ""  # exp(6 * 0.12) = 2.05
    assert "off the map" in doubt(result(0.0042))
    assert doubt(result(0.002, color=0.049)) == ""  # exp(6 * 0.153) = 2.5
    assert "the image differs" in doubt(result(0.002, color=0.051))
    assert doubt(result(0.002, 0.3)) == ""
    monitor.lose()
    assert "fall on the map" in doubt(result(0.002, 0.3))
    monitor.accept(result(0.002))
    assert doubt(result(0.002, 0.3)) == ""


def test_the_limit_follows_the_spread_of_the_residuals():
    rng = np.random.default_rng(3)
    monitor = QualityMonitor(Config(), MotionModel(TrackerConfig()))
    limits = []
    for sigma in (0.05, 0.17, 0.6):
        monitor.reset()
        for residual in 0.004 * np.exp(sigma * rng.normal(size=30)):
            monitor.accept(TrackingResult(np.eye(4), (1.0, 0.0), ACCEPTED, 0.9, residual, 0.1, 3, 0.01))
        limits.append(monitor.limits().residual_mm / 4)
    assert limits == pytest.approx([np.exp(6 * 0.12), np.exp(6 * 0.17), np.exp(6 * 0.23)], rel=0.25)


ANY = RegistrationRules(min_condition=0.0)
"""A wall does not determine its pose."""


def wall(offset: float, far: float) -> tuple[TsdfVolume, Level]:
    """A map of a flat textured wall at a distance, metres, and an image in which it is nearer by ``offset``, metres."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    gray = np.asarray(255 * (0.5 + 0.2 * np.sin(u / 4) * np.cos(v / 4)), np.uint8)
    frame = Frame(0.0, np.full(gray.shape, far, np.float32), np.repeat(gray[..., None], 3, axis=2))
    config = VolumeConfig(voxel_size=0.02, truncation_voxels=10, truncation_noise=0)
    volume = TsdfVolume(CAMERA, config, SENSOR, depth_max=6.0)
    for _ in range(3):
        volume.integrate(frame, np.eye(4))
    return volume, Level(CAMERA, frame.depth - np.float32(offset), gray.astype(np.float32) / np.float32(255))


@pytest.mark.parametrize("far", [1.0, 2.0, 3.0])
@pytest.mark.parametrize(("sigmas", "reason"), [(2.0, ""), (6.0, "off the map")])
def test_distances_are_judged_in_units_of_the_noise_at_their_depth(far, sigmas, reason):
    sigma, sigma_one = (SENSOR.sigma(z) for z in (far, 1.0))
    volume, level = wall(sigmas * sigma, far)
    # a Huber constant beyond all residuals, so that the mean square is that of the offset
    result = Tracker(TrackerConfig(huber=1.0), SENSOR, rules=ANY).judge(volume, level, np.eye(4), ones(level))
    assert result.residual == pytest.approx(sigmas * sigma_one, rel=0.1)
    assert result.accepted is (not reason)
    assert reason in result.verdict.reason


@pytest.mark.parametrize("exposure", [False, True])
def test_a_change_of_exposure_is_no_difference_from_the_map(exposure):
    volume, level = wall(0.0, 1.5)
    brighter = exposed(level, (1.1, 0.05))
    other = Level(CAMERA, level.depth, np.ascontiguousarray(level.intensity[:, ::-1]))
    tracker = Tracker(TrackerConfig(exposure=exposure), SENSOR)
    same, changed, wrong = (
        tracker.judge(volume, x, np.eye(4), ones(x)).color_residual for x in (level, brighter, other)
    )
    assert changed < same + 0.01
    assert wrong > 0.05
