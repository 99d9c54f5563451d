"""Movers: identity, place, extent and velocity of moving objects, against made-up images and the synthetic truth."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

import dudmap.lab.synthetic
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.config import Config, MoversConfig
from dudmap.core.frames.observation import Level
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.objects.moving_objects import MOST_WAITING, MovingObjects
from dudmap.core.objects.object_tracker import ObjectTracker
from dudmap.core.slam import Slam
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

CAMERA = Camera(fx=131, fy=131, cx=79.5, cy=59.5, width=160, height=120)
RNG = np.random.default_rng(3)
TEXTURE = np.kron(RNG.uniform(0, 1, (60, 80)), np.ones((3, 3)))


def board(x, z=2.0, width=0.5, texture=TEXTURE):
    """A textured board 0.5 m wide, 1 m high at (x, 0, z) before a wall at 4 m: mask and image (exact rendering)."""
    v, u = np.indices(CAMERA.shape)
    X, Y = (u - CAMERA.cx) / CAMERA.fx * z - x, (v - CAMERA.cy) / CAMERA.fy * z
    mask = (np.abs(X) < width / 2) & (np.abs(Y) < 0.5)
    depth = np.where(mask, z, 4.0).astype(np.float32)
    # bilinear texture, 1 cm per cell
    s, t = np.clip((X + 0.5) * 100, 0, 178.9), np.clip((Y + 0.6) * 100, 0, 178.9)
    i, j = s.astype(int), t.astype(int)
    a, b = s - i, t - j
    T = np.pad(texture, ((0, 180 - texture.shape[0] if texture.shape[0] < 180 else 0), (0, 0)), mode="edge")
    painted = (1 - b) * ((1 - a) * T[j, i] + a * T[j, i + 1]) + b * ((1 - a) * T[j + 1, i] + a * T[j + 1, i + 1])
    intensity = np.where(mask, 0.2 + 0.6 * painted, 0.5).astype(np.float32)
    return mask, Level(CAMERA, depth, intensity)


def joined(*images):
    mask = np.any([m for m, _ in images], axis=0)
    depth, intensity = images[0][1].depth.copy(), images[0][1].intensity.copy()
    for m, level in images[1:]:
        depth[m], intensity[m] = level.depth[m], level.intensity[m]
    return mask, Level(CAMERA, depth, intensity)


def test_nothing_moves():
    mask, level = board(0.0)
    assert ObjectTracker(MoversConfig()).update(0.0, np.zeros_like(mask), level, np.eye(4)) == []


def test_place_and_extent_in_the_world():
    mask, level = board(0.3)
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.0, np.pi / 2, 0.0]))
    (mover,) = ObjectTracker(MoversConfig()).update(0.0, mask, level, T)
    there = T[:3, :3] @ [0.3, 0, 2] + T[:3, 3]
    np.testing.assert_allclose(mover.centroid, there, atol=0.01)
    assert mover.points.shape == (mask.sum(), 3)
    np.testing.assert_array_equal(mover.mask, mask)
    extent = np.abs(T[:3, :3]) @ [0.5, 1.0, 0.0]
    np.testing.assert_allclose(mover.box[1] - mover.box[0], extent, atol=0.04)
    assert (mover.id, mover.age, mover.speed) == (1, 0.0, 0.0)


@pytest.mark.parametrize("velocity", [0.0, 0.6, 1.5])
@pytest.mark.parametrize("camera_speed", [0.0, 0.5])
def test_velocity_and_identity(velocity, camera_speed):
    """A board walks sideways while the camera moves too."""
    tracker = ObjectTracker(MoversConfig())
    for i in range(10):
        t = i / 30
        T = np.eye(4)
        T[0, 3] = camera_speed * t
        mask, level = board(-0.3 + velocity * t - T[0, 3])
        (mover,) = tracker.update(t, mask, level, T)
        assert mover.id == 1
    np.testing.assert_allclose(mover.velocity, [velocity, 0, 0], atol=0.05 + 0.03 * velocity)
    assert mover.age == pytest.approx(0.3)


def test_velocity_of_an_object_that_enters_the_image():
    """Its visible part grows, so that the centroid moves at half the speed; the surface tells the truth."""
    tracker = ObjectTracker(MoversConfig())
    for i in range(8):
        mask, level = board(-1.30 + i / 30)
        (mover,) = tracker.update(i / 30, mask, level, np.eye(4))
        assert mask[:, 0].any()
    np.testing.assert_allclose(mover.velocity, [1, 0, 0], atol=0.1)


def test_two_objects_keep_their_numbers():
    tracker, first = ObjectTracker(MoversConfig()), 0
    for i in range(12):
        shift = 0.03 * i
        mask, level = joined(board(-0.8 + shift, z=2.5), board(0.8 - shift, z=2.0, width=0.4))
        movers = tracker.update(i / 30, mask, level, np.eye(4))
        assert [mover.id for mover in movers] == [1, 2]
        left = min(movers, key=lambda mover: mover.centroid[0])
        first = first or left.id
        assert left.id == first


def test_objects_that_touch_stay_two():
    """Two boards meet at one depth, hang together for a while, and part again; each pixel stays with its board."""
    tracker = ObjectTracker(MoversConfig())
    touched = 0
    for i in range(90):
        way = 0.7 * np.cos(2 * np.pi * i / 89)  # apart, together, apart
        x = 0.26 + max(way, 0.0)
        (left, a), (right, b) = board(-x, z=2.0), board(x - 0.02, z=2.01)
        mask, level = joined((left, a), (right, b))
        movers = tracker.update(i / 30, mask, level, np.eye(4))
        touched += bool((left[:, :-1] & right[:, 1:]).any())
        assert [mover.id for mover in movers] == [1, 2]
        if i == 0:
            first = min(movers, key=lambda mover: mover.centroid[0]).id
        mover = next(mover for mover in movers if mover.id == first)
        assert (mover.mask & right).sum() < 0.15 * mask.sum()
        assert (mover.mask & left).sum() > 0.7 * left.sum()
    assert touched > 10


def test_an_object_keeps_its_number_over_a_short_gap_and_not_over_a_long_one():
    tracker = ObjectTracker(MoversConfig())
    mask, level = board(0.0)
    nothing = np.zeros_like(mask)
    numbers = []
    for t, seen in [(0, 1), (0.1, 0), (0.6, 1), (0.7, 0), (1.4, 1)]:
        numbers += [mover.id for mover in tracker.update(t, mask if seen else nothing, level, np.eye(4))]
    assert numbers == [1, 1, 2]


def test_fragments_are_one_object_and_specks_none():
    mask, level = board(0.0)
    split = mask.copy()
    split[90:93] = False  # cut off near the lower end
    split[2:4, 2:4] = True
    movers = ObjectTracker(MoversConfig()).update(0.0, split, level, np.eye(4))
    assert len(movers) == 1
    assert movers[0].mask.sum() == (split & mask).sum()


def test_far_fragments_are_two_objects():
    mask, level = joined(board(-0.5), board(0.5, width=0.2))
    assert len(ObjectTracker(MoversConfig()).update(0.0, mask, level, np.eye(4))) == 2


def test_lines_of_the_file(tmp_path):
    mask, level = board(0.3)
    movers = tuple(ObjectTracker(MoversConfig()).update(0.0, mask, level, np.eye(4)))
    record = RunRecord()
    for stamp, found in [(1.5, movers), (1.6, ())]:
        row = {}
        record.add_movers(row, SimpleNamespace(timestamp=stamp, movers=found))
        assert row["movers"] >= 0
    record.save_movers(tmp_path / "movers.jsonl")
    (line,) = (json.loads(text) for text in (tmp_path / "movers.jsonl").read_text().splitlines())
    assert line["timestamp"] == 1.5
    (row,) = line["movers"]
    assert set(row) == {"id", "centroid", "box", "velocity", "speed", "age", "pixels"}
    assert row["pixels"] == mask.sum()
    np.testing.assert_allclose(row["centroid"], [0.3, 0, 2], atol=0.01)


def test_movers_are_found_once_whoever_asks():
    objects = MovingObjects(Config())
    update = objects.tracker.update
    objects.tracker.update = lambda *arguments: time.sleep(0.01) or update(*arguments)
    finders = [
        objects.update(
            SimpleNamespace(timestamp=k / 30, labelled=level),
            SimpleNamespace(labels=SimpleNamespace(dynamic=mask), T_world_camera=np.eye(4)),
        )
        for k, (mask, level) in enumerate(board(0.01 * k) for k in range(8))
    ]
    with ThreadPoolExecutor(2) as threads:
        found = [list(threads.map(lambda find: find(), order)) for order in (finders, finders[::-1])]
    assert [one.id for (one,) in found[0]] == [1] * 8
    assert all(one is other for one, other in zip(found[0], found[1][::-1], strict=True))


def test_movers_are_found_when_they_are_asked_for():
    objects, direct, asked = MovingObjects(Config()), ObjectTracker(MoversConfig()), []
    update = objects.tracker.update
    objects.tracker.update = lambda timestamp, *rest: asked.append(timestamp) or update(timestamp, *rest)
    images = [board(0.01 * k) for k in range(MOST_WAITING + 5)]
    finders = [
        objects.update(
            SimpleNamespace(timestamp=k / 30, labelled=level),
            SimpleNamespace(labels=SimpleNamespace(dynamic=mask), T_world_camera=np.eye(4)),
        )
        for k, (mask, level) in enumerate(images)
    ]
    assert not asked
    found = [movers() for movers in reversed(finders)][::-1]
    assert asked == [k / 30 for k in range(5, len(images))]
    assert found[:5] == [()] * 5, "of what nobody asks for only the last frames are kept"
    for k, (mask, level) in list(enumerate(images))[5:]:
        (expected,) = direct.update(k / 30, mask, level, np.eye(4))
        assert found[k][0].id == expected.id
        assert found[k][0].velocity.tolist() == expected.velocity.tolist()


def test_a_walking_person_in_the_whole_system():
    camera = DEFAULT_CAMERA.resized(320, 240)
    sequence = dudmap.lab.synthetic.sequence(frames=60, seed=0, camera_path="still", start_dynamic=True, camera=camera)
    slam, off = Slam(sequence.camera), Slam(sequence.camera, Config().override(["movers.enabled=false"]))
    R = sequence.ground_truth.Ts_world_camera[0][:3, :3]
    errors, numbers = [], set()
    for i in range(0, 45):
        frame = sequence[i]
        result, truth = slam.process(frame), sequence.movers(i)[0]
        shown = sequence.mover_numbers(i)[1::2, 1::2] == truth.id
        movers = [m for m in result.movers if shown[m.mask].mean() > 0.7 and m.mask.sum() > 0.6 * shown.sum()]
        for mover in movers:
            if mover.age > 0.2:
                numbers.add(mover.id)
                errors.append(np.linalg.norm(R @ mover.velocity - truth.velocity))
        if i < 8:
            without = off.process(frame)
            assert without.movers == ()
            np.testing.assert_array_equal(without.T_world_camera, result.T_world_camera)
    assert len(errors) >= 10
    assert np.mean(errors) < 0.25
    assert len(numbers) == 1
