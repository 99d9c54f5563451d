"""Blocks that a device numbers have the numbers that the host gives them, and the host hears of them when it asks."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.gpu.device import make_backend

wp = pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")
make_backend("warp-cpu")

from failing import FULL, Device

from dudmap import synthetic
from dudmap.config import Config, VolumeConfig
from dudmap.geometry import se3
from dudmap.gpu import faults
from dudmap.gpu.numbering import IndexCopy
from dudmap.gpu.streams import HostQueue
from dudmap.mapping.volume import TsdfVolume
from dudmap.mapping.voxel_blocks import MAX_COORDINATE
from dudmap.slam import Slam
from small_maps import CAMERA

SMALL = CAMERA.scaled(1)
CONFIG = VolumeConfig(voxel_size=0.04, free_after=2, carve_rate=8)
KERNELS = ("mark_cells", "find_unknown", "allocate", "visible_slots", "pack_pixels", "observe_free", "enter_free")


def volume(device, *, on_host=False, config=CONFIG):
    out = TsdfVolume(SMALL, config, depth_max=3.0, backend=make_backend(device))
    out._index.on_host = on_host
    return out


def scene(seed, frames=14):
    """Depth images of a wall with a box in front of it that comes and goes, and a camera that goes away and back."""
    random = np.random.default_rng(seed)
    way = np.concatenate([np.linspace(0, 2.5, frames // 2), np.linspace(2.5, 0, frames - frames // 2)])
    for number, x in enumerate(way):
        depth = np.full(SMALL.shape, random.uniform(1.8, 2.6), np.float32)
        if number % 2 == 0:
            v, u = random.integers(0, 30), random.integers(0, 40)
            depth[v : v + 25, u : u + 30] = random.uniform(0.7, 1.2)
        depth[random.random(SMALL.shape) < 0.05] = 0
        color = random.integers(0, 256, (*SMALL.shape, 3)).astype(np.uint8)
        T = se3.exp(np.array([x, 0.3 * random.normal(), 0, *(0.1 * random.normal(size=3))]))
        yield SimpleNamespace(depth=depth, color=color), T


def content(volume):
    """Everything that a map holds in the host's memory."""
    blocks, window = volume.blocks, volume.window
    m = blocks.num_slots
    return {
        **blocks.arrays(window.near)._asdict(), "table": blocks.table, "cells": window.cells,
        "geometry": blocks.geometry[:m], "colors": blocks.colors[:m],
    }  # fmt: skip


def assert_equal(found, expected, *, but=()):
    for name, array in expected.items():
        if name not in but:
            np.testing.assert_array_equal(found[name], array, err_msg=name)


@pytest.mark.parametrize("seed", range(3))
def test_numbers_are_those_of_the_host(seed):
    """The index to the bit, with the window, the hash table and the voxels, which the same kernels fuse. Blocks are
    released and taken again, the window moves, and the host reads the map now and then."""
    random = np.random.default_rng(seed)
    on_host, device = volume("warp-cpu", on_host=True), volume("warp-cpu")
    released, moves = [], set()
    for number, (frame, T) in enumerate(scene(seed)):
        for one in (on_host, device):
            one.integrate(frame, T, count=1 + number % 3)
        assert device._index.copy is not None
        assert device.num_blocks == on_host.num_blocks
        assert device.view_bytes == on_host.view_bytes
        moves.add(tuple(device._index.place.origin))
        released.append(device._index.copy.counts.released)
        if random.random() < 0.3:
            assert_equal(content(device), content(on_host))
    assert len(moves) > 2
    assert max(released) > 5
    assert np.diff(released).min() < 0
    assert_equal(content(device), content(on_host))


@pytest.mark.parametrize("seed", range(3))
def test_numbers_are_those_of_the_cpu(seed):
    """Nothing is carved, since whether the last voxel of a block is empty may depend on a rounding."""
    config = CONFIG.model_copy(update={"carving": False})
    cpu, device = volume("cpu", config=config), volume("warp-cpu", config=config)
    for frame, T in scene(10 + seed, frames=8):
        for one in (cpu, device):
            one.integrate(frame, T)
    assert_equal(content(device), content(cpu), but=("geometry", "colors"))
    assert device.num_blocks > 300
    assert device.num_bytes == cpu.num_bytes


@pytest.mark.parametrize("settings", [{"carving": False}, {"take_turns": False}, {"antialias": True}])
def test_other_settings(settings):
    config = CONFIG.model_copy(update=settings)
    on_host, device = volume("warp-cpu", on_host=True, config=config), volume("warp-cpu", config=config)
    for frame, T in scene(7, frames=6):
        for one in (on_host, device):
            one.integrate(frame, T)
    assert_equal(content(device), content(on_host))


def test_far_from_the_origin():
    """Coordinates in single precision are those from the nearest local origin; where the host must refuse a reading,
    it numbers the blocks."""
    far = np.array([8192 * 0.32, 0, 0])
    on_host, device = volume("warp-cpu", on_host=True), volume("warp-cpu")
    for frame, T in scene(8, frames=4):
        T[:3, 3] += far
        for one in (on_host, device):
            one.integrate(frame, T)
    assert_equal(content(device), content(on_host))
    assert device._index.may_lead
    T[:3, 3] = (MAX_COORDINATE - 2) * 0.32, 0, 0
    device.look_at(T)
    assert not device._index.may_lead


def test_no_list_of_blocks_crosses_the_bus(monkeypatch):
    """From frame to frame counts come down and images go up, also when the window moves."""
    device, came, went = volume("warp-cpu"), [], []
    down, array = HostQueue.download, wp.array
    monkeypatch.setattr(HostQueue, "download", lambda self, one: came.append(one.size) or down(self, one))

    def up(data=None, *arguments, **named):
        if isinstance(data, np.ndarray):
            went.append(data.size)
        return array(data, *arguments, **named)

    moves = set()
    for number, (frame, T) in enumerate(scene(3)):
        if number == 10:  # the host takes over a small map after 1, 2, 4, 8, 16, ... frames
            came.clear()
            monkeypatch.setattr(wp, "array", up)
        device.integrate(frame, T)
        moves.add(tuple(device._index.place.origin))
    assert len(moves) > 2
    assert set(came) == {1}
    assert not went


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_frame_is_numbered_once_where_memory_runs_out(kernel, monkeypatch):
    """The host goes on from wherever the device has stopped."""
    on_host, device, broken = volume("warp-cpu", on_host=True), volume("warp-cpu"), Device(monkeypatch)
    with faults.told_to(lambda sentence: None):
        for number, (frame, T) in enumerate(scene(4, frames=6)):
            on_host.integrate(frame, T)
            if number == 3:
                broken.breaks(FULL, kernel)
            device.integrate(frame, T)
            broken.works()
    assert kernel in broken.launched
    voxels = () if kernel not in ("visible_slots", "pack_pixels") else ("geometry", "colors")  # fused by the CPU
    assert_equal(content(device), content(on_host), but=voxels)
    assert not faults.is_lost("cpu")


def test_a_device_that_is_lost_leaves_an_index_that_is_whole(monkeypatch):
    """Blocks, window and voxels are those of the last time that the host read them, and the map can be used."""
    device, told = volume("warp-cpu"), []
    broken, frames = Device(monkeypatch), list(scene(5))
    for frame, T in frames[:5]:
        device.integrate(frame, T)
    before = {name: array.copy() for name, array in content(device).items()}
    for frame, T in frames[5:7]:
        device.integrate(frame, T)
    assert device.num_blocks != np.count_nonzero(before["entry_of"] >= 0)
    broken.breaks()
    with faults.told_to(told.append):
        assert_equal(content(device), before, but=("near", "cells", "geometry", "colors"))
        broken.works()
        faults.forget()
    assert len(told) == 2
    blocks = device.blocks
    np.testing.assert_array_equal(np.sort(device.window.cells[device.window.cells >= 0]), device.window.near)
    np.testing.assert_array_equal(blocks.slots_at(blocks.slot_coords[device.active_slots]), device.active_slots)
    device.integrate(*frames[7])
    assert len(device.extract_mesh(1).faces) > 100


def test_voxels_of_another_block_are_not_kept():
    """A slot that another block got on the device is empty on the host until its voxels come down."""
    device = volume("warp-cpu")
    first, *others = scene(6)
    device.integrate(*first)
    _ = device.blocks.geometry, device.blocks.colors
    for one in others:
        device.integrate(*one)
    before = device._index.held.arrays(np.empty(0, np.int32))
    coords = before.slot_coords.copy()
    blocks = device.blocks
    other = np.any(blocks.slot_coords[: len(coords)] != coords, axis=1) | (blocks.entry_of[: len(coords)] < 0)
    assert other.any()
    assert not blocks.geometry_mirror.stale[: len(coords)][other].any()
    assert blocks.geometry[: len(coords)][other].any()


def test_what_the_map_knows_is_read_through_the_window():
    """The share of the information needs no hash table, and the host does not hear of new blocks."""
    on_host, device = volume("warp-cpu", on_host=True), volume("warp-cpu")
    for frame, T in scene(9, frames=3):
        for one in (on_host, device):
            one.integrate(frame, T)
    expected, found = (one.known_share(frame.depth, SMALL, T) for one in (on_host, device))
    assert device._index.copy.is_ahead
    device.grid.on_host()
    np.testing.assert_array_equal(device.known_share(frame.depth, SMALL, T), expected)
    assert device._index.copy is not None
    assert (expected > 0).mean() > 0.5
    np.testing.assert_array_equal(found, expected)


def test_a_system_leaves_the_index_on_the_device(monkeypatch):
    """Nothing that it does from frame to frame reads the blocks, so that the device takes them over once."""
    made, init = [], IndexCopy.__init__
    monkeypatch.setattr(IndexCopy, "__init__", lambda self, *arguments: made.append(self) or init(self, *arguments))
    recording = synthetic.sequence(frames=10, camera=CAMERA)
    slam = Slam(CAMERA, Config().override(["volume.voxel_size=0.03", "device=warp-cpu"]))
    for index in range(10):
        assert slam.process(recording[index]).state == "tracked"
    assert len(made) == 1
    assert made[0].is_ahead
    slam.volume.extract_mesh(1)
    assert slam.volume._index.copy is made[0]
