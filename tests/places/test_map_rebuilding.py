"""A map that is rebuilt over many frames is, once complete, the map that is rebuilt at once."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import Config, SensorConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.map.adaptive_volume import make_volume
from dudmap.core.places.atlas import Atlas
from dudmap.core.places.frame_store import FrameStore
from dudmap.core.places.map_rebuilding import MAX_IMMEDIATE, PER_FRAME, VIEW_DEPTH, nearest_views, view_distances
from dudmap.core.places.place_recognition import KeyframeDatabase
from wavy_wall import CAMERA, CONSTANT, wall

CONFIG = CONSTANT.model_copy(update={"min_weight": 1, "voxel_size": 0.02, "carving": True})
ADAPTIVE = CONFIG.model_copy(update={"adaptive": True, "adaptive_bend": 0.05})
COUNT = 40
EVERYTHING = np.ones(CAMERA.shape, dtype=bool)


def at(x, y=0.0):
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def add(atlas, second, T, submap=None):
    """Track a frame of the wall, a new one every second, and fuse it."""
    frame = wall(1.5 + 0.05 * (second % 3), second)
    atlas.add_pose(second, T)
    atlas.integrate(Frame(float(second), frame.depth, frame.color), EVERYTHING, T)


def walked(max_blocks=None, submaps=(COUNT,), volume=CONFIG):
    """An atlas after a walk of 15 cm a second along the wall, so many seconds in each submap."""
    config = Config()
    atlas = Atlas(
        lambda: make_volume(CAMERA, volume, SensorConfig(), 3.0, max_blocks=max_blocks),
        KeyframeDatabase(config.relocalization, CAMERA, config.sensor),
        FrameStore(CAMERA),
    )
    for number, count in enumerate(submaps):
        if number:
            atlas.start_submap()
        for second in range(len(atlas.poses), len(atlas.poses) + count):
            add(atlas, second, at(0.15 * second))
    return atlas


def corrected(atlas, rise):
    """Close a loop by which the path rises by so much per second; returns the new poses."""
    nodes = atlas.nodes(atlas.current)
    Ts = np.stack([at(atlas.history.frames[n].T_world_camera[0, 3], rise * n) for n in nodes])
    before = np.array([atlas.history.frames[n].T_world_camera for n in nodes])
    near = [nodes[i] for i in nearest_views(before, before[-1], MAX_IMMEDIATE)]
    provisional = atlas.make_volume()
    atlas.history.reintegrate(provisional, near, [Ts[nodes.index(n)] for n in near])
    atlas.correct(nodes, Ts, provisional, near)
    return Ts


def content(volume):
    """Everything that is known of each block of each level, by its coordinates."""
    out = {}
    for level, part in ((level, part) for all in volume.records() for level, part in enumerate([all, *all.finer])):
        voxels = {int(row): n for n, row in enumerate(part.owners)}
        for n, coords in enumerate(part.coords):
            m = voxels.get(n)
            words = None if m is None else (part.geometry[m].tobytes(), part.colors[m].tobytes(), int(part.fused[m]))
            out[(level, *coords)] = int(part.free_count[n]), words
    return out


def at_once(atlas):
    """The map of the stored frames as they are now."""
    volume = make_volume(CAMERA, atlas.volume.config, SensorConfig(), 3.0)
    atlas.history.reintegrate(volume)
    return volume


@pytest.mark.parametrize(
    ("max_blocks", "volume"), [(None, CONFIG), (300, ADAPTIVE)], ids=["one voxel size", "adaptive and paged"]
)
def test_the_complete_map_is_that_of_all_stored_frames(max_blocks, volume):
    """Frames that come meanwhile are part of it; until then the map holds what is around the camera."""
    atlas = walked(max_blocks, volume=volume)
    before = atlas.volume
    corrected(atlas, rise=0.01)
    assert 0 < atlas.volume.num_blocks < 0.8 * at_once(atlas).num_blocks
    frames = 0
    while atlas.rebuildings:
        frames += 1
        atlas.continue_rebuilding()
        if atlas.rebuildings:  # back along the wall
            add(atlas, COUNT + frames, at(0.15 * (COUNT - frames), 0.01 * (COUNT - frames)))
    assert COUNT / (PER_FRAME - 1) <= frames < 1.5 * COUNT  # one of two is for what is ahead at times
    assert atlas.volume is before  # views of the map stay connected
    expected = content(at_once(atlas))
    assert content(atlas.volume) == expected
    assert any(level == 1 for level, *_ in expected) == volume.adaptive


def test_the_provisional_map_grows_ahead_of_the_camera():
    atlas = walked()
    Ts = corrected(atlas, rise=0.01)
    provisional, number = atlas.volume, atlas.current
    assert np.nanmean(provisional.raycast(Ts[-1]).depth > 0) > 0.9
    far = Ts[3]
    assert np.count_nonzero(provisional.raycast(far).depth > 0) == 0
    assert atlas.volume_around(number, far) is provisional  # where a lost camera may be
    assert np.mean(provisional.raycast(far).depth > 0) > 0.8
    for second in range(5):  # the camera is there
        atlas.add_pose(COUNT + second, Ts[8])
        atlas.continue_rebuilding()
    assert np.mean(provisional.raycast(Ts[8]).depth > 0) > 0.8


def test_a_second_loop_in_the_meantime_begins_anew():
    atlas = walked()
    corrected(atlas, rise=0.01)
    for _ in range(5):
        atlas.continue_rebuilding()
    corrected(atlas, rise=0.02)
    assert len(atlas.rebuildings) == 1
    atlas.complete()
    assert not atlas.rebuildings
    np.testing.assert_allclose([frame.T_world_camera[1, 3] for frame in atlas.history.frames], 0.02 * np.arange(COUNT))
    assert content(atlas.volume) == content(at_once(atlas))


def test_a_small_map_is_rebuilt_at_once():
    atlas = walked(submaps=(MAX_IMMEDIATE,))
    corrected(atlas, rise=0.01)
    assert not atlas.rebuildings
    assert content(atlas.volume) == content(at_once(atlas))


@pytest.mark.parametrize(("max_blocks", "rebuilt"), [(None, True), (300, False), (300, True)])
def test_submaps_are_joined_over_many_frames(max_blocks, rebuilt):
    """The result is the map of the stored frames of both, also if that of the older one is being rebuilt."""
    first = 40
    atlas = walked(max_blocks, submaps=(first,))
    if rebuilt:
        corrected(atlas, rise=0.01)
        atlas.continue_rebuilding()
    atlas.start_submap()
    for second in range(first, first + 36):
        add(atlas, second, at(0.15 * second))
    assert atlas.volumes[0].blocks.num_voxel_blocks == 0 or max_blocks is None  # all of it waits on disk
    atlas.join(1, 0, at(0.1))
    assert list(atlas.volumes) == [atlas.current] == [0]
    assert np.mean(atlas.volume.raycast(atlas.poses[-1].T_world_camera).depth > 0) > 0.8
    for second in range(first + 36, first + 40):
        atlas.continue_rebuilding()
        add(atlas, second, at(0.15 * second))
    assert len(atlas.rebuildings[0].missing) > 20
    atlas.complete()
    assert content(atlas.volume) == content(at_once(atlas))


def test_maps_that_are_not_the_current_one_leave_the_memory():
    atlas = walked(max_blocks=300, submaps=(30, 5, 5))
    away = [volume.blocks.num_voxel_blocks for volume in atlas.volumes.values()]
    assert away[:2] == [0, 0] < [away[2]]
    whole = walked(submaps=(30, 5, 5))
    atlas.switch_to(0)
    whole.switch_to(0)
    assert atlas.volumes[2].blocks.num_voxel_blocks == 0
    for each in (atlas, whole):
        add(each, 100, at(0.15 * 29))  # in the window that the map was left with
        add(each, 101, at(0.15 * 12))
    for number in range(3):
        assert content(atlas.volumes[number]) == content(whole.volumes[number])


def test_a_map_is_painted_anew_over_many_frames_as_it_is_at_once():
    painted = []
    for gradually in (False, True):
        atlas, frames = walked(), 0
        before = content(atlas.volume)
        atlas.history.registered = lambda frame: replace(frame, color=255 - frame.color)
        atlas.recolor()
        if not gradually:
            atlas.complete()
        while not atlas.take_repainted():
            assert content(atlas.volume) == before
            assert frames < COUNT
            atlas.continue_rebuilding()
            frames += 1
        assert frames == (-(-COUNT // PER_FRAME) if gradually else 0)
        painted.append(content(atlas.volume))
        assert painted[-1] != before
    assert painted[0] == painted[1]


def test_the_distance_of_views_is_that_of_what_is_looked_at():
    """Cameras on a circle that look at its middle see the same; one that turns on the spot sees something else."""
    around = np.stack([se3.exp(np.array([0, 0, 0, 0, angle, 0])) for angle in (0.0, 0.5, 1.0, -1.5)])
    outside = around.copy()
    outside[:, :3, 3] = -VIEW_DEPTH * around[:, :3, 2]
    np.testing.assert_allclose(view_distances(outside, outside[0]), 0, atol=1e-12)
    expected = 2 * VIEW_DEPTH * np.sin(np.abs([0.0, 0.5, 1.0, -1.5]) / 2)
    np.testing.assert_allclose(view_distances(around, around[0]), expected, atol=1e-12)
    turned = se3.exp(np.array([0, 0, 0, 0.7, 0, 0])) @ around
    np.testing.assert_allclose(view_distances(turned, turned[0]), expected, atol=1e-12)
