"""``volume.adaptive`` on the device: a sequence, the memory limit, the other device, and what happens when it fails."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dudmap.gpu.device import make_backend

pytest.importorskip("warp", reason="Warp (dudmap[gpu]) is not installed, or has no wheel for this platform")

from failing import FULL, LOST, Device

from dudmap import synthetic
from dudmap.config import Config, SensorConfig
from dudmap.geometry import se3
from dudmap.gpu import faults, memory
from dudmap.kernels.cpu import CpuBackend
from dudmap.mapping.adaptive_volume import AdaptiveVolume
from dudmap.mapping.incremental_mesh import IncrementalMesh
from dudmap.mapping.volume_mirror import VolumeMirror
from dudmap.slam import Slam
from small_maps import CAMERA
from triangles import triangles
from wavy_wall import CAMERA as WALL_CAMERA
from wavy_wall import CONSTANT, wall

FRAMES, SAVED_AFTER, VOXEL = 7, 4, 0.02
SETTINGS = [f"volume.voxel_size={VOXEL}", "volume.adaptive=true", "volume.adaptive_bend=0.1"]
PRECISE = SensorConfig(sigma_base=0.0005, sigma_scale=0.0005)
BENT = CONSTANT.model_copy(
    update={"min_weight": 1, "voxel_size": 0.02, "adaptive": True, "adaptive_bend": 0.1, "adaptive_texture": 9.0}
)


@pytest.fixture
def device(monkeypatch):
    yield Device(monkeypatch)
    faults.forget()


@pytest.fixture
def told():
    """Sentences that are told instead of warned of."""
    sentences = []
    with faults.told_to(sentences.append):
        yield sentences


@pytest.fixture(scope="module")
def frames():
    recording = synthetic.sequence("desk", movers=["person"], frames=FRAMES, camera=CAMERA, noise="kinect")
    return [recording[index] for index in range(FRAMES)]


def processed(frames, *settings, path=None):
    """A system that has processed all frames, its poses and masks; saved on the way where there is a path."""
    slam = Slam(CAMERA, Config().override([*SETTINGS, *settings]))
    results = []
    for number, frame in enumerate(frames):
        if number == SAVED_AFTER and path is not None:
            slam.save(path)
        results.append(slam.process(frame))
    poses = np.array([result.T_world_camera for result in results])
    return slam, poses, np.array([result.dynamic_mask for result in results])


@pytest.fixture(scope="module")
def runs(frames, tmp_path_factory):
    """By device: file of the state on the way, system, poses and masks."""
    paths = {name: tmp_path_factory.mktemp("state") / f"{name}.db" for name in ("cpu", "warp-cpu")}
    return {name: (path, *processed(frames, f"device={name}", path=path)) for name, path in paths.items()}


def content(volume):
    """Words of all blocks of all levels, also of those on disk, by level and place."""
    out = {}
    for whole in volume.records():
        for level, part in enumerate([whole, *whole.finer]):
            for n, row in enumerate(part.owners):
                out[(level, *part.coords[row])] = np.stack([part.geometry[n], part.colors[n]])
    return out


def equal(one, other):
    return one.keys() == other.keys() and all(np.array_equal(words, other[key]) for key, words in one.items())


def assert_linked(volume):
    """Every finer block is the child that its parent knows."""
    for level, parents in zip(volume.levels, volume.all_blocks.parents, strict=True):
        slots = level.blocks.active_slots
        parent = level.parents[slots]
        np.testing.assert_array_equal(parents.slot_coords[parent], level.blocks.slot_coords[slots] >> 1)
        np.testing.assert_array_equal(level.children[parent, level.octants_of(slots)], slots)


def test_a_sequence_has_the_poses_masks_and_mesh_of_the_cpu(runs):
    """Bounds of ``test_sequence.py``; the smaller voxels are those of the CPU but for one block in a hundred."""
    (_, one, poses, masks), (_, other, other_poses, other_masks) = runs.values()
    apart = np.linalg.norm((poses - other_poses)[:, :3, 3], axis=1)
    assert np.median(apart) < 0.5e-3
    assert apart.max() < 3e-3
    assert (masks & other_masks).sum() / (masks | other_masks).sum() > 0.98
    expected, found = content(one.volume), content(other.volume)
    assert sum(key[0] == 1 for key in expected) > 100
    assert len(expected.keys() ^ found.keys()) < 0.01 * len(expected)
    distance = cKDTree(one.volume.extract_mesh(1).vertices).query(other.volume.extract_mesh(1).vertices)[0]
    assert (distance < VOXEL / 4).mean() > 0.99


def test_poses_and_masks_on_the_device_are_those_of_one_voxel_size(frames, runs):
    _, _, poses, masks = runs["warp-cpu"]
    slam, uniform_poses, uniform_masks = processed(frames, "device=warp-cpu", "volume.adaptive=false")
    assert not slam.volume.levels
    assert np.array_equal(poses, uniform_poses)
    assert np.array_equal(masks, uniform_masks)


@pytest.mark.parametrize(("first", "second"), [("warp-cpu", "warp-cpu"), ("warp-cpu", "cpu"), ("cpu", "warp-cpu")])
def test_a_system_is_continued_on_either_device(frames, runs, first, second):
    """On the same device bit for bit, on the other within the tolerance of a registration."""
    path, whole, poses, _ = runs[first]
    slam = Slam.resume(path, second)
    assert slam.volume._refinements[0].backend is slam.volume.backend
    assert isinstance(slam.volume.backend, CpuBackend) == (second == "cpu")
    for frame in frames[SAVED_AFTER:]:
        assert slam.process(frame).state == "tracked"
    expected, found = content(whole.volume), content(slam.volume)
    assert_linked(slam.volume)
    if first == second:
        assert np.array_equal(slam.trajectory.Ts_world_camera, poses)
        assert equal(found, expected)
        return
    assert np.linalg.norm((slam.trajectory.Ts_world_camera - poses)[:, :3, 3], axis=1).max() < 3e-3
    assert len(expected.keys() ^ found.keys()) < 0.02 * len(expected)


def walk(volumes, numbers):
    for number in numbers:
        T = se3.exp(np.array([0.8 * (number // 4), 0, 0, 0, 0, 0]))
        for volume in volumes:
            volume.integrate(wall(0.9, number % 3), T)


def volume_on(name, limit=None):
    return AdaptiveVolume(WALL_CAMERA, BENT, PRECISE, 1.5, make_backend(name), limit)


def test_a_frame_brings_no_voxels_to_the_host(monkeypatch):
    """Between the frames after which the host takes them over; blocks are examined and opened meanwhile."""
    volume, pulled = volume_on("warp-cpu"), []
    walk([volume], range(11))
    monkeypatch.setattr(memory.RowCopy, "_pull", lambda self, rows, host: pulled.append(rows))
    before = volume.levels[0].blocks.num_voxel_blocks
    walk([volume], range(11, 15))
    assert volume.levels[0].blocks.num_voxel_blocks > before + 20
    assert pulled == []


WAY = [*range(40), *range(7, -1, -1)]
"""Numbers of frames along a wall and at its beginning again."""


@pytest.fixture(scope="module")
def whole():
    volume = volume_on("warp-cpu")
    walk([volume], WAY)
    assert volume.levels[0].blocks.num_voxel_blocks > 300
    return volume


def test_a_memory_limit_changes_nothing_on_the_device(whole):
    paged = volume_on("warp-cpu", 900)
    walk([paged], WAY)
    assert paged.pager.num_blocks > 50
    assert paged.all_blocks.num_voxel_blocks < 0.8 * whole.all_blocks.num_voxel_blocks
    assert equal(content(paged), content(whole))
    assert_linked(paged)


def test_the_farthest_blocks_leave_a_device_that_is_full(whole, monkeypatch, told):
    """All levels share its memory, and none leaves it; the map is that of a larger device."""
    paged, per_row = volume_on("warp-cpu"), 2 * 512 * 4  # geometry and colours

    def mirrors():
        blocks = [paged.blocks, *(level.blocks for level in paged.levels)]
        return [mirror for one in blocks for mirror in (one.geometry_mirror, one.colors_mirror)]

    def free(device):
        return 1.25 * 1700 * per_row - sum(mirror.copy.array.size * 4 for mirror in mirrors() if mirror.copy)

    monkeypatch.setattr(memory, "free_memory", free)
    walk([paged], WAY)
    assert len(told) == 1
    assert "those farthest from the camera wait on disk" in told[0]
    assert all(mirror.copy is not None for mirror in mirrors())
    assert paged.pager.num_blocks > 50
    assert equal(content(paged), content(whole))


def test_a_map_that_does_not_fit_goes_on_on_the_cpu(monkeypatch, told):
    """Every level leaves the device, with what it had written."""
    reference, volume = volume_on("cpu"), volume_on("warp-cpu")
    walk([reference, volume], range(6))
    monkeypatch.setattr(memory, "free_memory", lambda device: 1000)
    walk([reference, volume], range(6, 30))
    assert "volume.voxel_size at least" in told[-1]
    for blocks in (volume.blocks, volume.levels[0].blocks):
        assert blocks.geometry_mirror.copy is None
        assert blocks.colors_mirror.copy is None
    expected, found = content(reference), content(volume)
    assert len(expected.keys() ^ found.keys()) < 0.01 * len(expected)


@pytest.mark.parametrize(
    ("kernel", "operation"), [("examine", "examine"), ("prolong", "prolong"), ("trace_levels", "raycast_levels")]
)
def test_the_cpu_does_what_has_too_little_memory(device, told, kernel, operation):
    reference, volume = volume_on("warp-cpu"), volume_on("warp-cpu")
    walk([reference], range(6))
    expected = reference.raycast(np.eye(4)).depth
    device.breaks(FULL, kernel)
    walk([volume], range(6))
    found = volume.raycast(np.eye(4)).depth
    device.works()
    assert told == [f"cpu has too little free memory for the operation {operation}, which is done on the CPU"]
    assert reference.levels[0].blocks.num_voxel_blocks > 50
    assert equal(content(volume), content(reference))
    assert (np.abs(found - expected) < 1e-5).mean() > 0.995


def test_the_live_mesh_follows_the_device():
    volume = volume_on("warp-cpu")
    mirror = VolumeMirror(volume)
    live = IncrementalMesh(mirror.volume)
    for number in range(0, 8, 4):
        walk([volume], range(number, number + 4))
        mirror.update()
        live.update()
    assert volume.levels[0].blocks.num_voxel_blocks > 50
    np.testing.assert_array_equal(triangles(live.mesh()), triangles(volume.extract_mesh()))


def test_a_lost_device_leaves_a_map_that_goes_on(device, told):
    volume = volume_on("warp-cpu")
    walk([volume], range(8))
    before = content(volume)  # the host has taken over the voxels
    fine = sum(key[0] == 1 for key in before)
    device.breaks()
    walk([volume], range(8, 16))
    assert told[0] == f"cpu failed ({LOST}); the run goes on on the CPU"
    after = content(volume)
    assert sum(key[0] == 1 for key in after) > fine > 50
    assert_linked(volume)
    assert len(volume.extract_mesh(1).faces) > 1000
    assert volume.raycast(np.eye(4)).depth.any()


def test_both_levels_are_brought_to_the_host_now_and_then(device, told):
    """After 8 frames, without the program reading them: what is lost then was not there before."""
    volume = volume_on("warp-cpu")
    walk([volume], range(8))
    device.breaks()
    observed = [np.count_nonzero(blocks.geometry) for blocks in (volume.blocks, volume.levels[0].blocks)]
    device.works()
    faults.forget()
    reference = volume_on("warp-cpu")
    walk([reference], range(8))
    full = [np.count_nonzero(blocks.geometry) for blocks in (reference.blocks, reference.levels[0].blocks)]
    assert observed[0] == full[0]
    assert observed[1] > 0.5 * full[1] > 0
