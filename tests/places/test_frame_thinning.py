"""Stored frames that the map has forgotten are removed: their number is bounded, and what is rebuilt stays the same."""

import numpy as np
import pytest

import dudmap.lab.synthetic
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places import frame_thinning
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_store import DEPTH_UNIT, FrameStore
from dudmap.core.places.frame_thinning import FrameThinning
from dudmap.core.places.loop_correction import LoopCorrector
from dudmap.core.places.loop_verification import LOCAL_FRAMES
from dudmap.core.places.place_recognition import Keyframe, KeyframeDatabase, PlacedFeatures
from dudmap.core.places.pose_graph import Edge

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
READINGS = 8
CONFIG = Config().override([f"volume.max_readings={READINGS}", "volume.voxel_size=0.05", "volume.take_turns=false"])
ENOUGH = int(CONFIG.similarity.threshold * (2 * READINGS + 1)) + 1  # newer frames that replace one
EVERYTHING = np.ones(CAMERA.shape, dtype=bool)


@pytest.fixture(autouse=True)
def nothing_untouched(monkeypatch):
    monkeypatch.setattr(frame_thinning, "MIN_KEPT", 0)


def at(x, y=0.0):
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def wall(second, distance=1.5, noise=0.0):
    """A wall with a relief that is fixed to the camera: all that matters here is how far it is."""
    rng = np.random.default_rng(second)
    depth = np.full(CAMERA.shape, distance) + noise * rng.normal(size=CAMERA.shape)
    return Frame(float(second), depth.astype(np.float32), rng.integers(0, 256, (*CAMERA.shape, 3), dtype=np.uint8))


class Walker:
    """An atlas whose frames, one a second, are all stored, and the thinning of them.

    Attributes:
        stored: How many frames were stored after each of them.
    """

    def __init__(self, config=CONFIG, camera=CAMERA):
        keyframes = KeyframeDatabase(config.relocalization, camera, config.sensor)
        self.atlas = Atlas(
            lambda: TsdfVolume(camera, config.volume, config.sensor), keyframes, FrameStore(camera, gap=1)
        )
        self.corrector = LoopCorrector(self.atlas)
        self.thinning = FrameThinning(config, self.atlas)
        self.stored = []

    @property
    def history(self):
        return self.atlas.history

    def see(self, T, frame=None, static=EVERYTHING, *, fuse=False, thin=True):
        second = len(self.atlas.poses)
        frame = wall(second) if frame is None else Frame(float(second), frame.depth, frame.color)
        self.atlas.add_pose(second, T)
        if fuse:
            self.atlas.integrate(frame, static, T)
        else:
            self.history.add(frame, static, T, self.atlas.current)
        if thin:
            self.thinning.thin()
        self.stored.append(len(self.history.kept))


def to_and_fro(count, steps=10, step=0.05):
    """Places along a wall, to and fro."""
    return [at(step * (steps - abs(n % (2 * steps) - steps))) for n in range(count)]


def test_a_camera_that_stays_keeps_what_the_map_remembers():
    walker = Walker()
    for second in range(5 * ENOUGH):
        walker.see(at(0), wall(second, noise=0.01))
    assert len(walker.history.kept) <= 4 / 3 * ENOUGH + 4
    kept = walker.history.kept
    assert kept[0] == 0  # the first one fixes the world
    assert kept[-ENOUGH:] == list(range(4 * ENOUGH, 5 * ENOUGH))
    for n in kept:
        expected = wall(n, noise=0.01).depth
        np.testing.assert_allclose(walker.history[n].frame.depth, expected, atol=0.51 * DEPTH_UNIT)


def test_what_is_hidden_from_newer_frames_is_kept_until_it_is_seen_again():
    """Somebody stands before the right half of a wall that the camera keeps seeing, and leaves at last."""
    walker, hidden = Walker(), EVERYTHING.copy()
    hidden[:, CAMERA.width // 2 :] = False
    for _ in range(2 * ENOUGH):
        walker.see(at(0))
    for _ in range(3 * ENOUGH):
        walker.see(at(0), static=hidden)
    assert walker.stored[-1] <= walker.stored[2 * ENOUGH] + 4 / 3 * ENOUGH + 4  # of each half as many as without
    wholly_seen = [stored for stored in walker.history if stored.static.all()]
    assert len(wholly_seen) >= ENOUGH
    for _ in range(3 * ENOUGH):
        walker.see(at(0))
    assert len(walker.history.kept) <= 4 / 3 * ENOUGH + 4
    assert walker.history.kept[1] > 5 * ENOUGH


def test_a_walk_without_return_keeps_all():
    walker = Walker()
    for second in range(4 * ENOUGH):
        walker.see(at(0.1 * second))
    assert len(walker.history.kept) == 4 * ENOUGH


def test_the_number_depends_on_the_space_and_not_on_the_time():
    walker = Walker()
    for T in to_and_fro(600):
        walker.see(T)
    early, late = max(walker.stored[200:300]), max(walker.stored[500:])
    assert late <= 1.05 * early < 100
    stored = np.array([walker.history.frames[n].T_world_camera[0, 3] for n in walker.history.kept])
    assert np.all(np.abs(stored[:, None] - np.arange(0, 0.51, 0.05)).min(axis=0) < 1e-9)  # no place is left out


def test_what_a_return_may_be_compared_with_stays():
    """A keyframe beside the wall was last seen at second 10: what was stored until then does not give way to later."""
    walker = Walker()
    features = PlacedFeatures(np.empty((0, 128), np.float32), np.empty((0, 3)))
    keyframe = Keyframe(5.0, at(0.3), features, 0, last_seen=10.0)
    walker.atlas.keyframes.keyframes.append(keyframe)
    for _ in range(3 * ENOUGH):
        walker.see(at(0))
    kept = [n for n in walker.history.kept if n <= 10]
    assert kept == [0, *range(11 - LOCAL_FRAMES, 11)]
    assert len(walker.history.kept) <= len(kept) + 4 / 3 * ENOUGH + 4
    keyframe.last_seen = 3.0 * ENOUGH
    for _ in range(40):
        walker.see(at(0))
    assert sum(n <= 10 for n in walker.history.kept) == 1


def test_poses_of_removed_images_are_corrected_as_before():
    """The images of the first visit are gone: its poses and keyframes still have the corrections of their own time."""
    walker = Walker()
    for x in [0.0] * 5 + [5.0] * 2 + [0.0] * (ENOUGH + 6):
        walker.see(at(x))
    features = PlacedFeatures(np.empty((0, 128), np.float32), np.empty((0, 3)))
    keyframe = Keyframe(3.0, at(0.0), features)
    walker.atlas.keyframes.keyframes.append(keyframe)
    assert [n for n in walker.history.kept if n < 7] == [0, 5, 6]
    nodes = walker.atlas.nodes(0)
    assert nodes == list(range(ENOUGH + 13))
    Ts_new = np.stack([at(frame.T_world_camera[0, 3], 0.1 * n) for n, frame in enumerate(walker.history.frames)])
    walker.atlas.correct(nodes, Ts_new, walker.atlas.make_volume())
    found = [round(pose.T_world_camera[1, 3], 9) for pose in walker.atlas.poses]
    np.testing.assert_allclose(found, 0.1 * np.arange(ENOUGH + 13))
    assert keyframe.T_world_camera[1, 3] == pytest.approx(0.3)
    edge = walker.corrector.measured_edge(Keyframe(3.2, at(0.0), features), at(0.0, 0.3), at(0.0, 0.3))
    assert edge is not None
    assert (edge.a, edge.b) == (3, nodes[-1])


def test_a_loop_after_many_visits_gives_as_good_a_map():
    """A view is seen many times, then the camera turns round once, drifting, until it sees it again. After the loop the
    map rebuilt without the removed frames is as near to the room as that of all frames."""
    camera, turn = Camera(65.6, 65.6, 39.5, 31.5, 80, 64), 45
    room = dudmap.lab.synthetic.sequence("room", movers=(), frames=turn, camera=camera, camera_path="round", seed=3)
    images, true = [room[n] for n in range(turn)], room.ground_truth.Ts_world_camera
    true = se3.inverse(true[0]) @ true
    config = Config().override([f"volume.max_readings={READINGS}", "volume.voxel_size=0.04"])
    way = [n for _ in range(12) for n in (0, 1, 2, 3, 4, 3, 2, 1)] + list(range(turn))
    errors, complete, stored = [], [], []
    for thin in (False, True):
        walker = Walker(config, camera)
        for n, index in enumerate(way):
            drift = se3.exp(np.array([0.0, 0.1, 0, 0, 0.05, 0]) * max(n + turn - len(way), 0) / turn)
            walker.see(drift @ true[index], images[index], np.ones(camera.shape, bool), fuse=True, thin=thin)
        stored.append(len(walker.history.kept))
        nodes = walker.atlas.nodes(0)
        T_old = walker.history.frames[nodes[-turn]].T_world_camera
        loop = Edge(nodes[-turn], nodes[-1], se3.inverse(T_old) @ true[-1], 0.005, 0.003)
        assert walker.corrector.correct(loop) is not None
        walker.atlas.complete()
        misses, shown = [], []
        for index in (0, 2, 4, 10, 25, turn - 1):
            seen, known = walker.atlas.volume.raycast(true[index]).depth, images[index].depth
            both = (seen > 0) & (known > 0)
            shown.append(both.sum() / (known > 0).sum())
            misses.append(np.median(np.abs(seen - known)[both]))
        errors.append(float(np.mean(misses)))
        complete.append(float(np.mean(shown)))
    assert stored[1] < 0.65 * stored[0]
    assert complete[1] > complete[0] - 0.002 > 0.85
    assert errors[1] < 1.1 * errors[0] + 0.001
