"""Place recognition: alignment, RANSAC and keyframes against ground truth, and the recovery of a kidnapped camera."""

from dataclasses import replace

import numpy as np
import pytest

import dudmap.lab.synthetic
from dudmap.config import Config, RelocalizationConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.alignment import kabsch, rigid_ransac
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.se3 import agree
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.places.place_recognition import KeyframeDatabase
from dudmap.core.slam import Slam
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence
from ring_corridor import ring_corridor

SMALL = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


def random_pose(rng, reach=1.0):
    return se3.exp(np.concatenate([rng.uniform(-reach, reach, 3), rng.uniform(-1, 1, 3)]))


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def test_kabsch_is_exact_and_never_a_mirror():
    rng = np.random.default_rng(1)
    T = random_pose(rng)
    b = rng.normal(size=(4, 3, 3))
    np.testing.assert_allclose(kabsch(moved(T, b), b), np.broadcast_to(T, (4, 4, 4)), atol=1e-9)
    mirrored = b * [1, 1, -1]
    assert np.linalg.det(kabsch(mirrored[:1].reshape(3, 3), b[0])[:3, :3]) == pytest.approx(1)
    cloud = rng.normal(size=(50, 3))
    assert np.linalg.det(kabsch(cloud * [1, 1, -1], cloud)[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.75])
def test_ransac_finds_the_motion_among_outliers(outliers):
    rng = np.random.default_rng(7)
    T = random_pose(rng)
    b = rng.uniform([-1, -1, 1], [1, 1, 3], (120, 3))
    a = moved(T, b) + rng.normal(0, 0.003, b.shape)
    wrong = rng.random(len(a)) < outliers
    a[wrong] = rng.uniform(-2, 2, (wrong.sum(), 3))
    found, inliers = rigid_ransac(a, b, np.full(len(a), 0.015))
    assert agree(found, T, 0.01, 0.5)
    assert (inliers[~wrong]).mean() > 0.95
    assert inliers[wrong].sum() <= 2
    again, _ = rigid_ransac(a, b, np.full(len(a), 0.015))
    np.testing.assert_array_equal(found, again)


def test_ransac_of_nothing():
    rng = np.random.default_rng(2)
    a, b = rng.uniform(-2, 2, (2, 40, 3))
    _, inliers = rigid_ransac(a, b, np.full(40, 0.01))
    assert inliers.sum() < 8
    assert not rigid_ransac(a[:2], b[:2], np.full(2, 0.01))[1].any()
    line = np.outer(np.linspace(0, 0.05, 30), [1, 0, 0])  # too short to define a pose
    assert not rigid_ransac(line, line, np.full(30, 0.01))[1].any()


@pytest.fixture(scope="module")
def room():
    """Views of a static room along a path, with their poses."""
    sequence = dudmap.lab.synthetic.sequence(movers=(), frames=60, camera_path="pan", seed=0, camera=SMALL)
    prepare = Preprocessor(SMALL)
    return [(prepare(sequence[i]), sequence.ground_truth.Ts_world_camera[i]) for i in range(0, 60, 6)]


def recognised(database, observation):
    return database.match(database.extract(observation))


def keyframes_of(room, **config):
    out = KeyframeDatabase(RelocalizationConfig(keyframe_gap=0, **config), SMALL)
    made = [out.add(observation, T) for observation, T in room]
    out.settle()
    return out, made


def test_keyframes_are_made_where_the_camera_has_not_been(room):
    known, made = keyframes_of(room)
    assert made[0]
    assert 2 <= len(known.keyframes) < len(room)
    observation, T = room[0]
    assert not known.add(observation, T)
    patient = KeyframeDatabase(
        RelocalizationConfig(keyframe_gap=3, keyframe_distance=1e-6, keyframe_angle_deg=1e-6), SMALL
    )
    assert [patient.add(observation, T @ se3.exp(np.full(6, 0.01 * i))) for i in range(9)] == [
        True, False, False, False, True, False, False, False, True
    ]  # fmt: skip


def test_memory_is_bounded_and_keeps_places_apart(room):
    known, _ = keyframes_of(room, max_keyframes=3, keyframe_angle_deg=2.0, keyframe_distance=0.02)
    assert len(known.keyframes) == 3
    all_of_them, _ = keyframes_of(room, keyframe_angle_deg=2.0, keyframe_distance=0.02)
    assert all(len(keyframe.features.points) <= 400 for keyframe in all_of_them.keyframes)

    def spread(keyframes):
        turns = [
            se3.rotation_angle(a.T_world_camera[:3, :3].T @ b.T_world_camera[:3, :3])
            for a in keyframes
            for b in keyframes
            if a is not b
        ]
        return min(turns)

    assert spread(known.keyframes) > spread(all_of_them.keyframes)


def test_a_known_place_is_recognised_exactly(room):
    known, _ = keyframes_of(room[::2])
    for observation, T in room[1::2]:
        candidates = recognised(known, observation)
        assert candidates
        assert agree(candidates[0].T_world_camera, T, 0.03, 1.0)
        np.testing.assert_array_equal(recognised(known, observation)[0].T_world_camera, candidates[0].T_world_camera)


def test_an_unknown_or_empty_view_is_not_recognised(room):
    known, _ = keyframes_of(room)
    elsewhere = dudmap.lab.synthetic.sequence("yard", movers=(), frames=1, camera=SMALL)
    prepare = Preprocessor(SMALL)
    assert recognised(known, prepare(elsewhere[0])) == []
    nothing = np.zeros(SMALL.shape, np.float32)
    assert recognised(known, prepare(Frame(0.0, nothing, np.zeros((*SMALL.shape, 3), np.uint8)))) == []
    assert recognised(known, prepare(Frame(0.0, nothing, room[0][0].rgb))) == []
    assert recognised(KeyframeDatabase(RelocalizationConfig(), SMALL), room[0][0]) == []


def test_moving_pixels_give_no_features(room):
    observation, T = room[0]
    dynamic = np.ones(SMALL.shape, dtype=bool)
    known = KeyframeDatabase(RelocalizationConfig(), SMALL)
    known.add(observation, T, dynamic)
    known.settle()
    assert known.keyframes == []
    dynamic[:, :160] = False
    known = KeyframeDatabase(RelocalizationConfig(), SMALL)
    assert known.add(observation, T, dynamic)
    known.settle()
    u = SMALL.project(known.keyframes[0].features.points)[:, 0]
    assert u.max() < 160


def turned_away(sequence, start, stop, yaw):
    """The same sequence with the camera turned about the vertical, at once, from one frame to another."""
    Ts = sequence.ground_truth.Ts_world_camera.copy()
    up = sequence.scene.home[:3, 1]
    place = Ts[start:stop, :3, 3].copy()
    Ts[start:stop] = se3.exp(np.concatenate([np.zeros(3), np.radians(yaw) * up])) @ Ts[start:stop]
    Ts[start:stop, :3, 3] = place
    return SyntheticSequence(
        sequence.scene, [], Trajectory(sequence.timestamps, Ts), sequence.camera, noise="kinect", seed=0, fps=30
    )


def errors(slam, sequence, count):
    """Per frame: (result, translation error in metres, None where lost or in a map of its own)."""
    first = se3.inverse(sequence.ground_truth.Ts_world_camera[0])
    out = []
    for i in range(count):
        result = slam.process(sequence[i])
        true = first @ sequence.ground_truth.Ts_world_camera[i]
        T = result.T_world_camera
        out.append((result, None if T is None or result.submap else np.linalg.norm(T[:3, 3] - true[:3, 3])))
    return out


def test_a_camera_that_is_suddenly_elsewhere_is_lost_and_found():
    sequence = dudmap.lab.synthetic.sequence(movers=(), frames=50, seed=1, camera=SMALL, camera_path="fast")
    sequence = turned_away(sequence, 15, 40, 150.0)
    slam = Slam(sequence.camera)
    rows = errors(slam, sequence, 45)
    assert [result.status for result, _ in rows] == ["tracked"] * 15 + ["lost"] * 25 + ["tracked"] * 5
    assert [i for i, (result, _) in enumerate(rows) if "relocalized" in result.events] == [40]
    assert not any(result.fused for result, _ in rows[15:40])
    assert max(error for _, error in rows if error is not None) < 0.017  # of 117 mm


def test_a_camera_that_went_on_in_the_dark_is_not_tracked_elsewhere_in_a_corridor():
    """The walls fit everywhere along it: neither they nor the last frame's depth say how far the camera has come."""
    corridor = ring_corridor(20, speed=1.2, camera=DEFAULT_CAMERA.resized(160, 120))
    slam, truth = Slam(corridor.camera, Config().override(["preprocess.depth_max=3"])), corridor.ground_truth
    for index in range(54):
        frame = corridor[index]
        dark = 30 <= index < 44  # 0.5 m
        result = slam.process(replace(frame, depth=np.zeros_like(frame.depth)) if dark else frame)
        if result.T_world_camera is not None and result.submap == 0:
            true = se3.inverse(truth.Ts_world_camera[0]) @ truth.Ts_world_camera[index]
            assert np.linalg.norm(result.T_world_camera[:3, 3] - true[:3, 3]) < 0.25, index  # of 1.7 m


def test_a_map_of_six_frames_is_enough_to_be_found_in():
    """A quarter of the view lies beyond what six frames have seen: less of the readings than usual falls on the map."""
    sequence = dudmap.lab.synthetic.sequence(movers=(), frames=40, seed=1, camera=SMALL, camera_path="dolly")
    sequence = turned_away(sequence, 6, 12, 25.0)
    rows = errors(Slam(sequence.camera), sequence, 14)
    assert all(result.status == "tracked" for result, _ in rows)
    assert max(error for _, error in rows) < 0.015  # of 127 mm


@pytest.mark.slow
@pytest.mark.parametrize("situation", ["kidnapped", "blocked"])
def test_the_situations(situation):
    sequence = dudmap.lab.synthetic.sequence(situation=situation, frames=120, seed=0, camera=SMALL)
    rows = errors(Slam(sequence.camera), sequence, 120)
    spans = sequence.parameters["covered_s"] + sequence.parameters["elsewhere_s"]
    back = int(np.searchsorted(sequence.timestamps, max(stop for _, stop in spans) + 0.15))
    lost = [i for i, (result, _) in enumerate(rows) if result.status == "lost"]
    assert lost
    if situation == "kidnapped":
        assert lost[-1] < back + 5
        assert any("relocalized" in result.events for result, _ in rows)
    else:  # it is where it was: it goes on as soon as it sees, recognised or not
        assert lost[-1] < back
    assert max(error for _, error in rows if error is not None) < 0.02
