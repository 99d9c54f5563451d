"""Recovery of the calibration from analytic images of three textured walls, taken by a moving camera."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.app.pipeline.calibration import INTERVAL, _around_keyframes, _enlarged, _Excerpt, calibrate_sequence
from dudmap.config import Config, PreprocessConfig, SensorConfig
from dudmap.core.calibration.adjustment import Adjustment, Fit, Pair, PairSet
from dudmap.core.calibration.depth_readout import lowest_readout
from dudmap.core.calibration.estimator import GROUPS, CalibrationEstimator, _Trial, mask_of
from dudmap.core.calibration.keyframes import KeyframeCollector, keyframe
from dudmap.core.calibration.vignetting import Brightness
from dudmap.core.frames.color_registration import color_projection, register_color
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import PARAMETERS, Calibration
from dudmap.core.geometry.camera import Camera

CAMERA = Camera(130.0, 130.0, 79.5, 59.5, 160, 120)
GIVEN = Calibration.registered(CAMERA)
FPS, FRAMES = 30.0, 80
NORMALS = np.array([[0.75, 0.1, 0.65], [-0.65, 0.15, 0.75], [0.05, 0.8, 0.6]])
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
REACH = np.array([1.6, 1.65, 1.55])


def poses(t: np.ndarray) -> np.ndarray:
    """A hand-held camera that looks around a corner, speeding up and slowing down about all axes, at times (n,)."""
    angles = [0.20 * np.sin(2.1 * t), 0.22 * np.sin(2.7 * t + 1), 0.18 * np.sin(3.3 * t + 2)]
    shift = [0.10 * np.sin(2.4 * t + 0.5), 0.08 * np.sin(3.1 * t), 0.08 * np.sin(1.9 * t + 1.5)]
    Ts = se3.exp_all(np.stack([*np.zeros((3, len(t))), *angles], axis=1))
    Ts[:, :3, 3] = np.stack(shift, axis=1)
    return Ts


def pose(t: float) -> np.ndarray:
    return poses(np.array([t]))[0]


def hits(rays: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Points where rays (..., 3) meet the nearest wall."""
    t = (REACH - origins @ NORMALS.T) / (rays @ NORMALS.T)
    t = np.where(t > 0, t, np.inf).min(axis=-1)
    return origins + rays * t[..., None]


def shade(X: np.ndarray) -> np.ndarray:
    """Texture of the walls: waves of several lengths and directions."""
    total = np.zeros(X.shape[:-1])
    for n, k in enumerate([(9, 4, 2), (-5, 11, 6), (13, -7, 9), (4, 15, -12), (-17, 6, 14), (21, 17, 3)]):
        total += np.sin(X @ np.array(k, float) + n)
    return np.clip(0.5 + 0.08 * total, 0, 1)


def record(truth: Calibration, index: int) -> Frame:
    """Depth and colour, this with the true lens and place, every row at its own time."""
    t = index / FPS
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    shares = (np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5
    Ts = poses(t + truth.depth_readout * shares)
    origins = np.broadcast_to(Ts[:, None, :3, 3], rays.shape)
    X = hits(rays @ Ts[:, :3, :3].swapaxes(1, 2), origins)
    depth = np.einsum("vui,vi->vu", X - origins, Ts[:, :3, 2]).astype(np.float32)
    of, k1, k2 = truth.camera, *truth.lens[:2]
    v, u = np.mgrid[: of.height, : of.width]
    distorted = np.stack([(u - of.cx) / of.fx, (v - of.cy) / of.fy], -1)
    straight = distorted
    for _ in range(20):
        r2 = (straight**2).sum(-1, keepdims=True)
        straight = distorted / (1 + k1 * r2 + k2 * r2**2)
    rays = np.concatenate([straight, np.ones((*u.shape, 1))], -1)
    taus = truth.delay + (truth.depth_readout + truth.readout) * ((np.arange(of.height) + 0.5) / of.height - 0.5)
    Ts = poses(t + taus) @ se3.inverse(truth.T_color_depth)
    rays, origins = rays @ Ts[:, :3, :3].swapaxes(1, 2), np.broadcast_to(Ts[:, None, :3, 3], rays.shape)
    gray = 255 * shade(hits(rays, origins)) + np.random.default_rng(index).normal(0, 1.5, u.shape)
    color = np.clip(np.round(gray), 0, 255).astype(np.uint8)
    return Frame(t, depth, np.repeat(color[..., None], 3, axis=2))


@cache
def recorded(name: str) -> tuple[Calibration, list[Frame]]:
    """A calibration that differs from the given one by some steps, and the frames taken with it."""
    truth = Calibration.registered(CAMERA).retract(np.array([STEPS[name].get(key, 0.0) for key in PARAMETERS]))
    truth = replace(truth, depth_readout=STEPS[name].get("depth_readout", 0.0))
    return truth, [record(truth, index) for index in range(FRAMES)]


def estimate(frames: list[Frame]):
    preprocess, collector = Preprocessor(CAMERA, PreprocessConfig(filter="none")), KeyframeCollector(GIVEN)
    for index, frame in enumerate(frames):
        wrong = se3.exp(np.random.default_rng(1000 + index).normal(0, 5e-4, 6))  # tracking is not perfect
        collector.add(preprocess(frame), pose(frame.timestamp) @ wrong, np.zeros(CAMERA.shape, bool))
    return CalibrationEstimator(GIVEN, SensorConfig()).estimate(collector.keyframes)


def displacement(one: Calibration, other: Calibration) -> float:
    """Root mean square distance of the pixels at which two colour cameras see the first depth image, pixels."""
    depth = record(Calibration.registered(CAMERA), 0).depth
    images = np.meshgrid(np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32))
    (u, v), (p, q) = (
        [register_color(image, depth, CAMERA, color_projection(c, np.zeros(6), 0.0)) for image in images]
        for c in (one, other)
    )
    return float(np.sqrt(np.mean((u - p) ** 2 + (v - q) ** 2)))


STEPS = {
    "as given": {},
    "place": {"translation_x": -0.025, "rotation_y": 0.01, "log_focal": np.log(0.95)},
    "lens and timing": {"k1": 0.1, "delay": -0.015, "readout": 0.02},
    "crop": {"center_x": 3.0, "center_y": -4.0},
    "shutter and timing": {"depth_readout": 0.027, "delay": 0.018},
}
TOLERANCE = {"translation_x": 3e-3, "translation_y": 3e-3, "rotation": np.radians(0.1), "delay": 2e-3, "readout": 3e-3}
"""Largest errors. How near the colour camera stands is hardly told from its focal length in so shallow a scene; what
both do together is measured by the displacement of the colours."""


@pytest.mark.parametrize("name", STEPS)
def test_what_is_wrong_is_found_and_what_is_right_stays(name):
    truth, frames = recorded(name)
    result = estimate(frames)
    error = result.calibration.step_to(truth)
    for key, value in zip(PARAMETERS, error, strict=True):
        assert abs(value) < TOLERANCE.get(key, TOLERANCE.get(key.split("_")[0], np.inf)), (key, value)
    assert displacement(result.calibration, truth) < 0.3
    assert result.calibration.depth_readout == pytest.approx(truth.depth_readout, abs=3e-3)
    off = abs(result.calibration.depth_readout - truth.depth_readout)
    assert off < 3 * result.calibration.depth_readout_sigma  # also where the halves agree by chance
    keys = {"timing": "delay", "lens": "k1", "center": "center_x", "geometry": "log_focal", "shutter": "depth_readout"}
    moved = {group for group, key in keys.items() if key in result.calibration.estimated}
    expected = {
        "as given": set(), "place": {"geometry"}, "lens and timing": {"timing", "lens"}, "crop": {"center"},
        "shutter and timing": {"shutter", "timing"},
    }  # fmt: skip
    assert moved >= expected[name]
    assert result.calibration.vignetting == 0
    if name == "as given":
        assert not result.calibration.estimated
        assert result.calibration.is_registered(CAMERA)
    assert np.all(np.isfinite(result.calibration.sigma))


def test_what_is_not_proven_is_as_uncertain_as_the_images_say(monkeypatch):
    monkeypatch.setattr("dudmap.core.calibration.estimator.EVIDENCE", np.inf)
    truth, frames = recorded("lens and timing")
    found = estimate(frames).calibration
    assert not found.estimated
    error = np.abs(found.step_to(truth))
    assert np.all(error < 3 * found.sigma)
    assert found.sigma[PARAMETERS.index("delay")] > 0.01  # of 15 ms that are missing


def test_no_readout_is_longer_than_a_frame():
    def lowest(a: float, b: float) -> float:
        return lowest_readout({r: a * r * r + b * r for r in (-0.02, 0.0, 0.02)}, 0.03)

    assert lowest(100, -4) == pytest.approx(0.02)
    assert lowest(100, -10) == 0.03  # the vertex is at 50 ms
    assert (lowest(-100, -1), lowest(-100, 1)) == (0.03, -0.03)  # the better end where the costs have no minimum
    collector = KeyframeCollector(GIVEN)
    for index in range(3):
        observation = Preprocessor(CAMERA, PreprocessConfig(filter="none"))(recorded("as given")[1][index])
        collector.add(observation, pose(index / FPS), np.zeros(CAMERA.shape, bool))
    assert collector.keyframes[0].interval == pytest.approx(1 / FPS)


FAULTS = ("place", 0.5), ("shutter and timing", 0.4)


@pytest.mark.parametrize(("name", "vignetting"), FAULTS)
def test_vignetting_is_found_beside_other_faults(name, vignetting):
    v, u = np.indices(CAMERA.shape)
    away = (np.square(u - 79.5) + np.square(v - 59.5)) / (79.5**2 + 59.5**2)
    left = np.exp(-vignetting * away)[..., None]
    frames = [replace(frame, color=np.round(frame.color * left).astype(np.uint8)) for frame in recorded(name)[1]]
    found = estimate(frames).calibration
    assert "vignetting" in found.estimated
    assert abs(found.vignetting - vignetting) < max(3 * found.vignetting_sigma, 0.01)
    assert found.vignetting_sigma < 0.02


def test_where_nothing_can_be_compared_no_vignetting_is_claimed():
    numbers, none = np.array([[0, 1]]), np.zeros(0)
    nothing = Brightness(numbers, np.zeros(0, np.int64), none, none)
    found, sigma = nothing.fitted()
    assert found == 0
    assert np.isnan(sigma)
    assert nothing.costs(0.3).tolist() == [0.0]


class Walls:
    """A recording of the walls, which remembers what was read."""

    name, camera, calibration, ground_truth = "walls", CAMERA, None, None
    timestamps = np.arange(FRAMES) / FPS

    def __init__(self, frames: list[Frame]) -> None:
        self.frames, self.read = frames, []

    def __len__(self) -> int:
        return FRAMES

    def __getitem__(self, index: int) -> Frame:
        self.read.append(index)
        return self.frames[index]


def test_a_recording_is_calibrated_in_one_quick_pass():
    truth, frames = recorded("place")
    walls = Walls(frames)
    found = calibrate_sequence(walls, Config(), Calibration.registered(CAMERA)).calibration
    assert walls.read == list(range(FRAMES))
    assert "log_focal" in found.estimated
    assert displacement(found, truth) < 0.5 < displacement(Calibration.registered(CAMERA), truth) / 5


def test_the_images_of_the_quick_pass_are_halved_and_its_result_is_for_whole_ones():
    whole = replace(CAMERA, fx=520.0, fy=520.0, cx=318.5, cy=238.0, width=640, height=480)
    given = Calibration(replace(whole, fx=500.0, cx=322.0), np.eye(4), 0.01)
    depth, color = np.full((480, 640), 2.0, np.float32), np.zeros((480, 640, 3), np.uint8)
    depth[:, 320:], color[:, 320:] = 3.0, 200
    whole_sequence = Walls([])
    whole_sequence.camera = whole
    whole_sequence.timestamps = np.arange(5) / (2.0 / INTERVAL)  # twice as fast as needed
    excerpt = _Excerpt(whole_sequence, given, 1, 5, 1.0)
    excerpt._sequence = [Frame(n / FPS, depth, color) for n in range(5)]
    assert len(excerpt) == 3
    frame = excerpt[2]
    assert frame.timestamp == 4 / FPS
    assert (frame.depth == depth[::2, ::2]).all()
    assert (frame.color == color[::2, ::2]).all()
    u = 401.0  # a column of the whole image, which lies at (u - 0.5) / 2 in the halved one
    ray = ((u - 0.5) / 2 - excerpt.camera.cx) / excerpt.camera.fx
    assert ray == pytest.approx((u - whole.cx) / whole.fx)
    found = _enlarged(replace(excerpt.calibration, sigma=np.ones(13)), given.camera, 1)
    assert found.camera == given.camera
    assert found.sigma.tolist() == [2.0 if name.startswith("center") else 1.0 for name in PARAMETERS]


def test_of_a_long_recording_only_keyframes_and_their_neighbours_are_read():
    times = np.arange(240) / 30
    read = _around_keyframes(times, range(240))
    assert read[:9] == [0, 1, 2, 6, 7, 8, 12, 13, 14]
    assert len(read) == 120
    assert _around_keyframes(times, range(120)) == list(range(120))  # four seconds
    slow = np.arange(80) / 10
    assert _around_keyframes(slow, range(80)) == list(range(79))


def freed(free) -> set[str]:
    """Groups that are free, of two of which one is a part of the other the larger one."""
    names = {name for name, members in GROUPS.items() if free[mask_of(members)].all()}
    return names - {"center"} if "geometry" in names else names


class Explained:
    """Stands for the adjustment: a cost per set of groups that are free, in both halves of the time."""

    levels = (0,)

    def __init__(self, costs: dict[frozenset[str], float | tuple[float, float]]) -> None:
        self.table, self.asked = costs, []

    def solve(self, pairs, start, free, levels=()):
        return replace(start, calibration=replace(start.calibration, estimated=tuple(sorted(freed(free))))), np.eye(13)

    def costs(self, pairs, fit):
        self.asked.append(frozenset(fit.calibration.estimated))
        wobble = 0.01 * np.cos(np.arange(40.0))
        cost = self.table.get(frozenset(fit.calibration.estimated), 1.0)
        parts = cost if isinstance(cost, tuple) else (0.5 * cost, 0.5 * cost)  # of intensities and depths
        return np.array(parts)[:, None] * (1 + wobble)


def proven(costs: dict[str, float | tuple[float, float]]) -> set[str]:
    """Groups that leave their given values, by the cost that every set of groups leaves."""
    estimator = CalibrationEstimator(Calibration.registered(CAMERA), SensorConfig())
    table = {frozenset(key.split()): value for key, value in costs.items()}
    estimator.adjustment = Explained(table)
    given = Fit(estimator.given, np.empty((0, 4, 4)), np.empty((0, 2)))
    halves = [SimpleNamespace(numbers=np.arange(80).reshape(40, 2))] * 2
    start = _Trial(np.zeros(13, bool), [given] * 2, [estimator.adjustment.costs([], given)] * 2, halves)
    trial, evidence = estimator._proven(halves, start)
    assert set(evidence) == set(GROUPS)
    return freed(trial.free)


def test_groups_that_explain_nothing_without_each_other_are_found_together():
    both = {"geometry timing": 0.5, "geometry timing lens": 0.5, "geometry lens": 1.1, "timing lens": 1.2}
    alone = {"geometry": 1.1, "timing": 1.05, "lens": 1.02}
    assert proven(both | alone) == {"geometry", "timing"}  # and not the lens, which adds nothing
    assert proven(alone | {"geometry timing lens": 0.995}) == set()  # too little to leave the given values
    assert proven({"timing": 0.8, "timing lens": 0.799, "geometry timing": 0.81}) == {"timing"}
    # the geometry has more evidence than the lens, and too little to leave the given values
    assert proven({"geometry": 0.96, "lens": 0.97, "geometry lens": 0.96, "timing lens": 0.97}) == {"lens"}
    # what explains the intensities at the cost of the depths is not used
    assert proven({"timing": (0.2, 0.7), "lens": (0.4, 0.45)}) == {"lens"}
    # the geometry explains too little more than the principal point, or so much more that it replaces it
    assert proven({"center": 0.93, "geometry": 0.9, "center timing": 0.94}) == {"center"}
    assert proven({"center": 0.8, "geometry": 0.5}) == {"geometry"}
    everything = {"geometry timing lens": 0.3, "geometry timing": 0.5, "geometry lens": 0.6, "timing lens": 0.7}
    assert proven(alone | everything) == {"geometry", "timing", "lens"}


def test_pairs_that_share_a_frame_are_less_evidence_than_others():
    given = Fit(Calibration.registered(CAMERA), np.empty((0, 4, 4)), np.empty((0, 2)))
    gains = np.random.default_rng(3).normal(0.1, 0.1, 80).repeat(4)  # every four are alike
    apart, shared = np.arange(320).reshape(160, 2), np.stack([np.arange(40).repeat(4), np.arange(40, 200)], axis=1)
    evidence = []
    for frames in (apart, shared):
        trial = _Trial(np.zeros(13, bool), [given] * 2, [], [SimpleNamespace(numbers=frames)] * 2)
        evidence.append(trial.evidence(gains))
    assert evidence[1] == pytest.approx(evidence[0] / 2)


def test_standard_deviations_grow_with_what_the_halves_of_the_time_differ_by():
    given = Calibration.registered(CAMERA)
    estimator, covariance = CalibrationEstimator(given, SensorConfig()), np.diag(np.full(13, 0.5e-6))

    def disagreement(step: float) -> float:
        found = [given, given.retract(np.full(13, step) * ([1] * 3 + [0] * 10))]
        fits = [Fit(each, np.empty((0, 4, 4)), np.empty((0, 2))) for each in found]
        solve = lambda pairs, start, free, levels: (start, covariance)  # noqa: E731
        estimator.adjustment = SimpleNamespace(levels=[0], solve=solve)
        return estimator._disagreement([None, None], fits)

    assert disagreement(1e-4) == 1.0
    assert disagreement(1e-2) == pytest.approx(np.sqrt(3 * 1e-4 / 1e-6 / 13))


def test_the_normal_equations_of_a_known_calibration_are_those_of_the_poses():
    preprocess, collector = Preprocessor(CAMERA, PreprocessConfig(filter="none")), KeyframeCollector(GIVEN)
    for frame in recorded("as given")[1][:12]:
        collector.add(preprocess(frame), pose(frame.timestamp), np.zeros(CAMERA.shape, bool))
    given = Calibration.registered(CAMERA)
    adjustment, pairs = Adjustment(given, SensorConfig()), PairSet([Pair(*collector.keyframes[:2])])
    fit, level = Fit.tracked(pairs, given), adjustment.levels[-1]
    parts = [adjustment._linearize_pairs(pairs, fit, level, (0.01, 1.0), begin) for begin in (0, 13)]
    np.testing.assert_allclose(parts[1].H[0], parts[0].H[0, 13:, 13:], rtol=1e-6)
    np.testing.assert_allclose(parts[1].b[0], parts[0].b[0, 13:], rtol=1e-6)
    systems = [adjustment._linearize(pairs, fit, level, (0.01, 1.0), known=known) for known in (False, True)]
    steps = [system.step(np.zeros(13, bool)) for system in systems]
    np.testing.assert_allclose(steps[1], steps[0], rtol=1e-6)
    assert steps[1][13:].all()
    assert not steps[1][:13].any()
    moved = [fit.moved(pairs, step, system.parts, (0.01, 1.0)) for step, system in zip(steps, systems, strict=True)]
    np.testing.assert_allclose(moved[1].light, moved[0].light, rtol=1e-6)
    few = PairSet([Pair(*collector.keyframes[:2])], stride=2)
    assert len(few.points) == sum(-(-len(frame.points) // 2) for frame in collector.keyframes[:2])


def test_relative_poses_follow_the_poses_of_both_frames():
    """A step of the frames' poses in the normal equations of a pair against differences of its depth residuals."""
    preprocess, collector = Preprocessor(CAMERA, PreprocessConfig(filter="none")), KeyframeCollector(GIVEN)
    for frame in recorded("as given")[1][:30]:
        collector.add(preprocess(frame), pose(frame.timestamp), np.zeros(CAMERA.shape, bool))
    given = Calibration.registered(CAMERA)
    adjustment = Adjustment(given, SensorConfig())
    pair = PairSet([Pair(collector.keyframes[0], collector.keyframes[-1])])
    rng, level, scales = np.random.default_rng(2), adjustment.levels[-1], (1e6, 1.0)  # colour counts for nothing

    def cost_and_gradient(steps):
        fit = Fit.tracked(pair, given)
        fit = replace(fit, Ts_camera_world=se3.exp_all(np.array(steps)) @ fit.Ts_camera_world)
        part = adjustment._linearize_pairs(pair, fit, level, scales, 0)
        return part.b[0, 13:], part.H[0, 13:, 13:]

    start = [rng.normal(0, 2e-3, 6), rng.normal(0, 2e-3, 6)]
    step = [rng.normal(0, 2e-4, 6), rng.normal(0, 2e-4, 6)]
    before, H = cost_and_gradient(start)
    after, _ = cost_and_gradient([a + b for a, b in zip(start, step, strict=True)])
    predicted = H @ np.concatenate(step)  # the change of the gradient
    assert np.linalg.norm(after - before - predicted) < 0.15 * np.linalg.norm(predicted)


@pytest.mark.parametrize("shift", [0.0, -0.25])
def test_the_colours_of_what_moves_have_no_part_in_a_calibration(shift):
    """However bright it is, and wherever the colour camera sees it: it changes no intensity that is compared."""
    given = Calibration(CAMERA, np.array([[1, 0, 0, shift], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    frame, mask = recorded("as given")[1][0], np.zeros(CAMERA.shape, bool)
    mask[40:80, 60:100] = True
    aside = round(-shift * CAMERA.fx / float(np.median(frame.depth[mask])))
    taken = []
    for brightness in (0, 255):
        color = frame.color.copy()
        color[40:80, 60 - aside : 100 - aside] = brightness
        observation = Preprocessor(CAMERA, PreprocessConfig(filter="none"))(replace(frame, color=color))
        taken.append(keyframe(observation, given, np.eye(4), np.zeros(6), mask).intensities)
    for dark, bright in zip(*taken, strict=True):
        np.testing.assert_allclose(dark, bright, atol=1e-6)
        assert 0.02 < np.isnan(dark).mean() < 0.4
