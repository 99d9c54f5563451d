"""The map with several voxel sizes: where they open and close, what is carved, and what the readers of the map see."""

from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config, SensorConfig, VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.adaptive_volume import AdaptiveVolume
from dudmap.core.map.incremental_mesh import IncrementalMesh, VolumeMirror
from dudmap.core.map.refinement import MAX_CALM, _drop_calm
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.saved_map import MAP_FILE
from dudmap.core.slam import Slam
from dudmap.lab import synthetic
from refined_maps import analytic_map, sphere
from triangles import triangles

CAMERA = Camera(120.0, 120.0, 79.5, 59.5, 160, 120)
SENSOR = SensorConfig(sigma_base=0.0005, sigma_scale=0.001)
CONFIG = VolumeConfig(voxel_size=0.02, adaptive=True)


def ridge(z=0.7, wall=1.2, gray=120, slope=1.0):
    """A vertical edge at depth ``z`` in the middle, between two faces that meet at a right angle, before a wall."""
    x = np.broadcast_to((np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx, CAMERA.shape)
    depth = z / (1 - slope * np.abs(x))
    depth[np.abs(x) > 0.3] = wall
    return Frame(0.0, depth.astype(np.float32), np.full((*CAMERA.shape, 3), gray, np.uint8))


def flat(z=0.8):
    return Frame(0.0, np.full(CAMERA.shape, z, np.float32), np.full((*CAMERA.shape, 3), 120, np.uint8))


def fused(frames, config=CONFIG, poses=None, sensor=SENSOR):
    volume = AdaptiveVolume(CAMERA, config, sensor, depth_max=3.0)
    for number, frame in enumerate(frames):
        volume.integrate(frame, np.eye(4) if poses is None else poses[number])
    return volume


def fine_centres(volume, number=0):
    """Centres (n, 3) of the blocks of a level, metres."""
    level = volume.levels[number]
    return (level.blocks.slot_coords[level.blocks.active_slots] + 0.5) * 8 * level.voxel_size


def assert_linked(volume):
    """Every block of every level is the child that its parent knows."""
    parents = volume.blocks
    for level in volume.levels:
        slots = level.blocks.active_slots
        parent = level.parents[slots]
        np.testing.assert_array_equal(parents.slot_coords[parent], level.blocks.slot_coords[slots] >> 1)
        np.testing.assert_array_equal(level.children[parent, level.octants_of(slots)], slots)
        assert np.count_nonzero(level.children >= 0) == len(slots)
        parents = level.blocks


def test_smaller_voxels_open_at_an_edge_and_not_on_its_faces():
    volume = fused([ridge()] * 6)
    centres = fine_centres(volume)
    assert len(centres) > 10
    assert np.median(np.hypot(centres[:, 0], centres[:, 2] - 0.7)) < 0.08  # within a block of the edge
    faces = np.abs(np.abs(centres[:, 0]) - 0.15) < 0.05
    assert np.count_nonzero(faces) < 0.2 * len(centres)
    assert_linked(volume)
    assert fused([flat()] * 6).levels[0].blocks.num_voxel_blocks == 0


def test_nothing_opens_where_the_sensor_does_not_resolve_it():
    noisy = SensorConfig(sigma_base=0.011, sigma_scale=0.0)  # more than half a voxel
    assert len(fine_centres(fused([ridge()] * 6, sensor=noisy))) == 0


def test_fine_colours_open_smaller_voxels_as_well():
    rng = np.random.default_rng(0)
    spots = np.kron(rng.integers(0, 2, (30, 20)), np.ones((4, 8)))[..., None] * 255
    frame = Frame(0.0, flat().depth, np.broadcast_to(spots, (*CAMERA.shape, 3)).astype(np.uint8))
    assert len(fine_centres(fused([frame] * 6))) > 10


def test_two_levels_are_nested():
    volume = fused([ridge(0.5)] * 24, CONFIG.model_copy(update={"adaptive_levels": 2, "adaptive_bend": 0.25}))
    assert len(fine_centres(volume, 1)) > 10
    assert_linked(volume)


def test_smaller_voxels_are_dropped_where_the_surface_has_become_flat():
    config = CONFIG.model_copy(update={"max_readings": 4})  # so that the old shape soon fades
    volume = fused([ridge(0.78, 0.8)] * 6, config)
    assert len(fine_centres(volume)) > 10
    for _ in range(100):
        volume.integrate(flat(0.79), np.eye(4))
    seen = fine_centres(volume)
    assert np.count_nonzero(seen[:, 2] < 0.84) == 0  # what is left stands behind the wall
    assert_linked(volume)


def test_smaller_voxels_are_dropped_after_calm_examinations_in_a_row_only():
    """A block that is needed every now and then stays; one is dropped with the last of MAX_CALM calm examinations."""
    dropped, calm = [], np.zeros(2, np.uint8)
    level = SimpleNamespace(calm=calm, drop=lambda slots: dropped.append(slots.tolist()))
    children = np.full((2, 8), -1, np.int32)
    children[:, 3] = 0, 1
    surface = np.ones((2, 8), bool)
    for number in range(3 * MAX_CALM):
        needed = np.zeros((2, 8), np.float32)
        needed[0, 3] = number % MAX_CALM == MAX_CALM - 1
        _drop_calm(level, children, surface, needed)
        assert dropped[-1] == ([1] if number >= MAX_CALM - 1 else [])


def test_what_moves_away_leaves_nothing_in_the_smaller_voxels():
    volume = fused([ridge()] * 8)
    assert len(fine_centres(volume)) > 10
    for _ in range(80):
        volume.integrate(flat(1.2), np.eye(4))
    mesh = volume.extract_mesh()
    assert mesh.vertices[:, 2].min() > 1.15  # the edge was at 0.7 m
    assert fine_centres(volume)[:, 2].min(initial=9) > 1.0
    assert_linked(volume)


def test_the_map_without_refinement_is_that_of_one_voxel_size():
    """Base blocks are the same, bit for bit: tracking, carving and free space do not depend on the finer levels."""
    volume = fused([ridge()] * 6)
    uniform = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02), SENSOR, 3.0)
    for _ in range(6):
        uniform.integrate(ridge(), np.eye(4))
    np.testing.assert_array_equal(volume.blocks.geometry, uniform.blocks.geometry)
    np.testing.assert_array_equal(volume.blocks.colors, uniform.blocks.colors)
    assert volume.num_bytes > uniform.num_bytes


def test_poses_and_masks_are_those_of_one_voxel_size():
    small = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
    recording = synthetic.sequence("desk", movers=["person"], frames=8, camera=small, noise="kinect")
    config = Config().override(["volume.voxel_size=0.02", "device=cpu"])
    systems = [Slam(small, config), Slam(small, config.override(["volume.adaptive=true", "volume.adaptive_bend=0.1"]))]
    for number in range(len(recording)):
        one, other = (system.process(recording[number]) for system in systems)
        assert one.T_world_camera is not None
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        np.testing.assert_array_equal(one.dynamic_mask, other.dynamic_mask)
    assert isinstance(systems[1].volume, AdaptiveVolume)
    assert len(fine_centres(systems[1].volume)) > 10


@pytest.mark.parametrize("mirrored", [False, True], ids=["direct", "by the copy for another thread"])
def test_the_incremental_mesh_follows(mirrored):
    """Bit for bit, also where voxel sizes change beside a part that was extracted before, and where blocks go."""
    volume, poses = AdaptiveVolume(CAMERA, CONFIG.model_copy(update={"carve_rate": 16}), SENSOR, 3.0), np.eye(4)
    mirror = VolumeMirror(volume)
    live, counts = IncrementalMesh(mirror.volume if mirrored else volume), []
    for number in range(25):
        poses[0, 3] = 0.02 * number
        volume.integrate(flat(1.2) if number > 10 else ridge(), poses)
        if number % 4 == 0:
            mirror.update()
            live.update()
            counts.append(volume.all_blocks.num_voxel_blocks - volume.num_blocks)
            np.testing.assert_array_equal(triangles(live.mesh()), triangles(volume.extract_mesh()))
    assert max(counts) > 20
    assert counts[-1] < max(counts)


def test_pieces_may_ask_for_another_weight():
    volume = fused([ridge()] * 6)
    paged = volume.for_camera(CAMERA, max_blocks=10**6)
    few, many = paged.extract_mesh(1), paged.extract_mesh(19)
    assert 1000 < len(many.faces) < len(few.faces)
    np.testing.assert_array_equal(triangles(many), triangles(volume.extract_mesh(19)))


def test_a_saved_map_is_the_same_again(tmp_path):
    volume = fused([ridge(0.5)] * 24, CONFIG.model_copy(update={"adaptive_levels": 2, "adaptive_bend": 0.25}))
    volume.save(tmp_path / MAP_FILE)
    again = TsdfVolume.load(tmp_path / MAP_FILE)
    assert isinstance(again, AdaptiveVolume)
    assert_linked(again)
    assert [level.blocks.num_voxel_blocks for level in again.levels] == [
        level.blocks.num_voxel_blocks for level in volume.levels
    ]
    mesh, other = volume.extract_mesh(), again.extract_mesh()
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(other, name))
    again.integrate(ridge(0.5), np.eye(4))  # a loaded map goes on
    assert_linked(again)


def test_views_are_those_of_the_smaller_voxels():
    distance = sphere((0.0, 0.0, 0.6), 0.1)
    every = lambda level, centres: np.ones(len(centres), bool)  # noqa: E731
    depths = []
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
    b, c = rays @ (0.0, 0.0, 0.6), np.sum(rays**2, axis=-1)
    exact = np.where(b**2 - c * (0.36 - 0.01) > 0, (b - np.sqrt(np.maximum(b**2 - c * 0.35, 0))) / c, 0)
    inner = exact > 0
    inner[:-1] &= inner[1:]
    inner[1:] &= inner[:-1]
    for refine in (None, every):
        volume = analytic_map(distance, (-1, -1, 2), (1, 1, 5), 0.02, 2, refine)
        view = volume.raycast(np.eye(4), CAMERA)
        hit = (view.depth > 0) & inner
        assert np.count_nonzero(hit) > 0.8 * np.count_nonzero(inner)
        depths.append(np.abs(view.depth - exact)[hit].mean())
        normal = (rays * view.depth[..., None] - (0, 0, 0.6)) / 0.1
        assert np.median(np.sum(normal * view.normals, axis=-1)[hit]) > 0.99
    assert depths[1] < 0.3 * depths[0]


def test_colours_can_be_replaced_where_the_other_map_is_not_refined():
    """A map of the kept frames only is refined elsewhere; no voxel loses its colour by that."""
    volume, painted = fused([ridge()] * 6), fused([ridge(gray=200)] * 6)
    colored = volume.levels[0].blocks.colors != 0
    volume.take_colors(painted)
    np.testing.assert_array_equal(volume.levels[0].blocks.colors, painted.levels[0].blocks.colors)
    coarse = fused([ridge(gray=60)] * 2)
    assert coarse.levels[0].blocks.num_voxel_blocks == 0
    coarse.levels[0].blocks.colors[-1] = 900  # of some block, all slots being in use
    volume.take_colors(coarse)
    blocks = volume.levels[0].blocks
    near = colored & (blocks.geometry != 0)
    red, shade = (blocks.colors[near] >> 20) & 1023, blocks.geometry[near] & 0xFF
    assert np.count_nonzero(red == 0) < 0.02 * len(red)  # beside the end of what the two frames showed
    np.testing.assert_allclose(red[red > 0], 4 * 60, atol=4)
    np.testing.assert_allclose(shade[shade > 0], 60, atol=1)
    view = volume.raycast(np.eye(4))
    np.testing.assert_allclose(view.color[view.depth > 0], 60, atol=1)


def test_a_map_without_its_finer_levels_is_saved_and_goes_on(tmp_path):
    """The result of a merge, which fuses the coarsest level."""
    volume = fused([ridge()] * 2)
    volume.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as data:
        np.savez(tmp_path / "coarse.npz", **{key: data[key] for key in data if not key.endswith("1")})
    again = TsdfVolume.load(tmp_path / "coarse.npz")
    again.save(tmp_path / "again.npz")
    for _ in range(4):
        again.integrate(ridge(), np.eye(4))
    assert len(fine_centres(again)) > 10
    assert_linked(again)
