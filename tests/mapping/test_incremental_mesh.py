"""The mesh that follows a growing map equals a full extraction, and touches only what changed."""

import numpy as np
import pytest

from dudmap.core.geometry import se3
from dudmap.core.map.incremental_mesh import EDGE, IncrementalMesh, VolumeMirror
from dudmap.core.map.volume import TsdfVolume
from triangles import triangles
from wavy_wall import CAMERA, CONSTANT, wall

CONFIG = CONSTANT.model_copy(update={"min_weight": 1})


def assert_equal(live, volume):
    expected = triangles(volume.extract_mesh())
    assert len(expected) > 100
    np.testing.assert_array_equal(triangles(live.mesh()), expected)


def turned(degrees):
    return se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0]))


@pytest.fixture
def volume():
    return TsdfVolume(CAMERA, CONFIG, depth_max=4.0)


def test_it_equals_the_full_extraction_after_every_frame(volume):
    live = IncrementalMesh(volume)
    for number, angle in enumerate((0, 3, -40, 40, 40)):
        volume.integrate(wall(1.5 + 0.02 * number, number), turned(angle))
        live.update()
        assert_equal(live, volume)
    assert len(live.chunks) > 5


def test_several_frames_may_pass_between_updates(volume):
    live = IncrementalMesh(volume)
    volume.integrate(wall(1.5), turned(0))
    live.update()
    for number in range(3):
        volume.integrate(wall(1.4, number), turned(20 * number))
    live.update()
    assert_equal(live, volume)


def test_only_what_was_written_is_extracted_again():
    volume = TsdfVolume(CAMERA, CONFIG.model_copy(update={"voxel_size": 0.0125}), depth_max=4.0)
    live = IncrementalMesh(volume)
    for angle in (0, 90, 180):
        volume.integrate(wall(1.5), turned(angle))
    live.update()
    assert live.update() == []
    before = dict(live.chunks)
    volume.integrate(wall(1.45, 1), turned(90))
    again = set(live.update())
    assert_equal(live, volume)
    kept = {key for key in before if live.chunks.get(key) is before[key]}
    assert len(kept) > len(before) / 4
    assert not kept & again
    size = EDGE * volume.block_size
    looked_at = turned(90)[:3, 2]
    for key in again:
        assert (np.array(key) + 0.5) * size @ looked_at > -size


def test_blocks_that_give_back_their_voxels_leave_the_mesh():
    volume = TsdfVolume(CAMERA, CONFIG.model_copy(update={"carve_rate": 8, "carving": True}), depth_max=4.0)
    live = IncrementalMesh(volume)
    volume.integrate(wall(1.0), np.eye(4))
    live.update()
    first = set(live.chunks)
    for number in range(60):
        volume.integrate(wall(2.5, number), np.eye(4))
        if number % 7 == 0:
            live.update()
            assert_equal(live, volume)
    given_back = volume.blocks.num_voxel_blocks < volume.blocks.num_slots
    assert given_back or first - set(live.chunks), "something must have been given back"
    live.update()
    assert_equal(live, volume)


def test_slots_that_changed_hands_between_updates(volume):
    """A slot given back and taken again elsewhere leaves its old place without a surface."""
    live = IncrementalMesh(volume)
    volume.integrate(wall(1.5), np.eye(4))
    live.update()
    slots = volume.active_slots
    volume._frame_number += 1
    volume.blocks.written[slots] = volume._frame_number
    volume.window.release(slots, volume.blocks, volume.config.free_after)
    volume.integrate(wall(1.5), turned(100))
    assert not set(volume.blocks._released) & set(volume.active_slots.tolist())
    live.update()
    assert_equal(live, volume)


def test_an_empty_map_has_an_empty_mesh(volume):
    live = IncrementalMesh(volume)
    assert live.update() == []
    assert len(live.mesh().faces) == 0


def test_a_loaded_map_is_meshed_whole(volume, tmp_path):
    for angle in (0, 60):
        volume.integrate(wall(1.5), turned(angle))
    volume.save(tmp_path / "map.npz")
    live = IncrementalMesh(TsdfVolume.load(tmp_path / "map.npz"))
    live.update()
    np.testing.assert_array_equal(triangles(live.mesh()), triangles(volume.extract_mesh()))
    live._volume.integrate(wall(1.4), turned(60))
    live.update()
    assert_equal(live, live._volume)


def test_a_map_made_anew_is_meshed_anew(volume):
    live = IncrementalMesh(volume)
    for angle in (0, 60):
        volume.integrate(wall(1.5), turned(angle))
    live.update()
    before = set(live.chunks)
    volume.__init__(CAMERA, CONFIG, depth_max=4.0)
    assert set(live.update()) >= before
    assert not live.chunks
    for angle in (-60, -60, -60):
        volume.integrate(wall(1.5), turned(angle))
    live.update()
    assert_equal(live, volume)


# -- the copy for another thread --------------------------------------------------------------------------------------


def test_a_mirror_follows_a_growing_volume(volume):
    mirror = VolumeMirror(volume)
    live = IncrementalMesh(mirror.volume)
    for number, angle in enumerate((0, 3, -40, 40, 120)):
        volume.integrate(wall(1.5 + 0.02 * number, number), turned(angle))
        if number % 2 == 0:
            mirror.update()
            live.update()
            assert_equal(live, volume)


def test_a_mirror_that_copies_a_few_blocks_at_a_time_catches_up(volume):
    mirror = VolumeMirror(volume)
    live = IncrementalMesh(mirror.volume)
    for number, angle in enumerate((0, 5, 90, 180)):
        volume.integrate(wall(1.5 + 0.02 * number, number), turned(angle))
        mirror.update(limit=40)
        live.update()
    assert len(live.mesh().faces) < len(volume.extract_mesh().faces)
    for _ in range(volume.num_blocks // 40 + 1):
        mirror.update(limit=40)
        live.update()
    assert_equal(live, volume)


def test_a_mirror_does_not_change_by_itself(volume):
    mirror = VolumeMirror(volume)
    volume.integrate(wall(1.5), turned(0))
    mirror.update()
    before = triangles(mirror.volume.extract_mesh())
    volume.integrate(wall(1.3, 1), turned(30))
    np.testing.assert_array_equal(triangles(mirror.volume.extract_mesh()), before)


def test_a_mirror_follows_a_volume_that_was_cleared(volume):
    mirror = VolumeMirror(volume)
    live = IncrementalMesh(mirror.volume)
    for number in range(3):
        volume.integrate(wall(1.5, number), turned(0))
    mirror.update()
    live.update()
    volume.clear()
    volume.integrate(wall(1.2), turned(90))
    mirror.update()
    live.update()
    assert_equal(live, volume)
