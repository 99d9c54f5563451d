"""The frame store: what is stored and how exactly, and the map rebuilt from it."""

import numpy as np
import pytest

import dudmap.lab.synthetic
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import DEPTH_UNIT, FrameStore
from dudmap.errors import MapError

CAMERA = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)


def shifted(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


def smooth_frame(rng, timestamp):
    v, u = np.mgrid[0:120, 0:160]
    depth = (1 + 0.005 * u + 0.01 * v + rng.normal(0, 0.002, u.shape)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    color = np.stack([u, v, (u + v) // 2], axis=-1).astype(np.uint8)
    return Frame(timestamp, depth, color)


def test_frames_come_back_as_they_were():
    rng = np.random.default_rng(1)
    history = FrameStore(CAMERA, gap=1)
    frames = [smooth_frame(rng, 0.1 * n) for n in range(7)]
    masks = [rng.random((120, 160)) < 0.7 for _ in frames]
    for n, (frame, mask) in enumerate(zip(frames, masks, strict=True)):
        assert history.add(frame, mask, shifted(0.1 * n), submap=n // 4)
    assert len(history) == 7
    assert [frame.submap for frame in history.frames] == [0, 0, 0, 0, 1, 1, 1]
    for n, stored in enumerate(history):
        assert stored.frame.timestamp == frames[n].timestamp
        np.testing.assert_allclose(stored.frame.depth, frames[n].depth, atol=0.51 * DEPTH_UNIT)
        np.testing.assert_array_equal(stored.frame.depth == 0, frames[n].depth == 0)
        assert np.abs(stored.frame.color.astype(int) - frames[n].color).mean() < 2
        np.testing.assert_array_equal(stored.static, masks[n])
        np.testing.assert_array_equal(stored.T_world_camera, shifted(0.1 * n))
    np.testing.assert_array_equal(history[2].static, masks[2])  # in any order


def test_like_frames_count_towards_the_last_kept_one():
    frame = smooth_frame(np.random.default_rng(2), 0.0)
    everything = np.ones((120, 160), dtype=bool)
    history = FrameStore(CAMERA, distance=0.08, angle_deg=5.0, gap=4)
    kept = [history.add(frame, everything, shifted(x)) for x in (0, 0.05, 0.07, 0.09, 0.09, 0.09, 0.09, 0.09)]
    assert kept == [True, False, False, True, False, False, False, True]
    assert [frame.count for frame in history.frames] == [3, 4, 1]
    turn = shifted(0.09) @ se3.exp([0, 0, 0, 0, np.radians(5.5), 0])
    assert history.add(frame, everything, turn)
    assert history.add(frame, everything, turn, submap=1)  # another map


def test_a_full_disk_is_one_sentence():
    history, frame = FrameStore(CAMERA, gap=1), smooth_frame(np.random.default_rng(3), 0.0)

    def keep():
        history.add(frame, np.ones((120, 160), dtype=bool), shifted(0))
        return history[len(history) - 1]  # written by now at the latest

    keep()
    history._file._connection.execute("PRAGMA max_page_count = 1")
    with pytest.raises(MapError, match=r"fused frames cannot be stored in .*full.*TMPDIR"):
        keep()


@pytest.fixture(scope="module")
def room():
    return dudmap.lab.synthetic.sequence(scene="room", movers=(), frames=24, fps=6, camera=CAMERA, seed=2)


def test_map_built_again_equals_the_map(room):
    live, history = TsdfVolume(room.camera), FrameStore(room.camera, gap=1)
    Ts = room.ground_truth.Ts_world_camera
    everything = np.ones(room.camera.shape, dtype=bool)
    for n in range(len(room)):
        live.integrate(room[n], Ts[n])
        history.add(room[n], everything, Ts[n])
    again = TsdfVolume(room.camera)
    history.reintegrate(again)
    seen, rebuilt = live.raycast(Ts[12]), again.raycast(Ts[12])
    both = (seen.depth > 0) & (rebuilt.depth > 0)
    assert both.sum() > 0.98 * (seen.depth > 0).sum()
    assert np.quantile(np.abs(seen.depth - rebuilt.depth)[both], 0.95) < 0.001
    difference = (seen.color.astype(int) - rebuilt.color)[both]
    assert np.abs(difference).mean() < 5  # JPEG
    assert np.all(np.abs(difference.mean(axis=0)) < 1)


def test_poses_replace_the_stored_ones_and_counts_are_weights(room):
    history = FrameStore(room.camera, gap=1)
    left = np.zeros(room.camera.shape, dtype=bool)
    left[:, :80] = True
    Ts = room.ground_truth.Ts_world_camera
    for _ in range(3):
        history.add(room[0], left, np.eye(4))
    volume = TsdfVolume(room.camera)
    history.reintegrate(volume, [0, 1, 2], [Ts[0]] * 3)
    view = volume.raycast(Ts[0])
    expected = room[0].depth > 0
    assert (view.depth > 0)[:, :70][expected[:, :70]].mean() > 0.8
    once, thrice = TsdfVolume(room.camera), TsdfVolume(room.camera)
    history.reintegrate(once, [0], [Ts[0]])
    history.frames[0].count = 3
    history.reintegrate(thrice, [0], [Ts[0]])
    slots = once.active_slots
    np.testing.assert_array_equal(slots, thrice.active_slots)
    weights = [(v.blocks.geometry[slots] >> 8) & 0xFF for v in (once, thrice)]
    known = weights[0] > 0
    assert known.any()
    np.testing.assert_array_equal(weights[1][known], np.minimum(3 * weights[0][known].astype(int), 255))
    assert not (once.raycast(Ts[0]).depth > 0)[:, 90:].any()


def test_colours_are_stored_as_recorded_and_registered_when_they_are_read():
    frame = smooth_frame(np.random.default_rng(4), 1.0)
    recorded = Frame(1.0, frame.depth, np.ascontiguousarray(frame.color[:60, :80]), 1.02)  # another camera's size
    history, asked = FrameStore(CAMERA, gap=1), []

    def registered(stored):
        asked.append(stored)
        return Frame(stored.timestamp, stored.depth, frame.color, stored.color_timestamp)

    history.add(recorded, np.ones((120, 160), dtype=bool), shifted(0), exposure=(0.5, 0.0))
    assert history[0].frame.color.shape == (60, 80, 3)  # as they are
    assert np.abs(history[0].frame.color - 0.5 * recorded.color).mean() < 2
    history.registered = registered
    assert np.array_equal(history[0].frame.color, frame.color)
    assert asked[0].color_timestamp == 1.02
    assert asked[0].color.shape == (60, 80, 3)
