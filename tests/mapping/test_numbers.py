"""Voxels and counters saturate and never wrap; a map far from the origin is as accurate as one at it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dudmap.config import Config, SensorConfig, VolumeConfig
from dudmap.core.backends.threads import kernel
from dudmap.core.formulas.voxel import fuse_color, fuse_voxel, pack_pixel_color, pack_reading
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.block_window import LOCAL_GRID
from dudmap.core.map.volume import TsdfVolume, fusion_parameters
from dudmap.core.slam import Slam
from dudmap.core.tracking.frame_view import PoseEstimate
from dudmap.core.tracking.tracker import TrackingResult
from dudmap.core.verdict import ACCEPTED
from dudmap.fleet.map_fusion import MAX_COUNT, BlockSums, fused
from dudmap.lab import synthetic

CONFIG = Config().override(["volume.voxel_size=0.02"])
MAX_STEPS = 32767
DEPTH_MAX = 6.0
FAR = np.array([7071.0, -50.0, 7071.0])
"""A place 10 km from the origin, metres."""


@kernel
def fuse_once(word, depth, free, red, green, blue, gain, z, repeats, by_unit, old_color, p):
    """One reading into one voxel; the new words."""
    reading = pack_reading(depth, free, np.float32(1) / p.depth_unit)
    color = pack_pixel_color(red, green, blue, gain)
    word, share = fuse_voxel(word, reading, color, z, repeats, by_unit, p)
    return word, fuse_color(old_color, color, share)


def parameters(volume, sensor):
    """FusionParameters of a map."""
    from dudmap.core.backends.cpu.backend import single

    return single(fusion_parameters(volume, sensor, DEPTH_MAX))


def unpacked(word):
    """Distance in steps, weight and intensity, by plain integers."""
    word = int(word) & 0xFFFFFFFF
    steps = word >> 16
    return steps - (1 << 16) if steps >= 1 << 15 else steps, (word >> 8) & 0xFF, word & 0xFF


MAPS = [
    (VolumeConfig(), SensorConfig()),
    (VolumeConfig(max_weight=255, max_readings=255, carve_rate=64), SensorConfig()),
    (VolumeConfig(voxel_size=0.1, truncation_voxels=64, truncation_behind_voxels=64), SensorConfig(sigma_scale=0.1)),
]
extreme = st.sampled_from([0, 1, 2, 127, 128, 254, 255])


@settings(max_examples=400, deadline=None)
@given(
    st.sampled_from(MAPS),
    st.one_of(st.sampled_from([-MAX_STEPS, MAX_STEPS, 0, -1]), st.integers(-MAX_STEPS, MAX_STEPS)),
    extreme, extreme, extreme, extreme, extreme, st.integers(1, 16), st.floats(0.06, DEPTH_MAX),
    st.one_of(st.just(DEPTH_MAX), st.floats(0.05, DEPTH_MAX)), st.sampled_from([1, 2, 255, 100_000]),
)  # fmt: skip
def test_fusion_saturates(chosen, steps, weight, intensity, red, green, blue, gain, z, depth, repeats):
    volume, sensor = chosen
    p = parameters(volume, sensor)
    weight = min(weight, volume.max_weight)
    word = np.int32(np.uint32((steps & 0xFFFF) << 16 | weight << 8 | intensity).astype(np.int32))
    old = np.int32((4 * red) << 20 | (4 * green) << 10 | 4 * blue)
    numbers = (np.float32(value) for value in (z, repeats, 1 / p.sdf_unit))
    new, color = fuse_once(word, np.float32(depth), np.float32(depth), red, green, blue, gain, *numbers, old, p)
    new_steps, new_weight, new_intensity = unpacked(new)
    s = depth - z
    if new != word:
        if weight:  # an empty reading counts as the truncation distance, at least that in front
            low, high = min(s, p.band.front) / p.sdf_unit, s / p.sdf_unit
            rounding = 2 + p.depth_unit / p.sdf_unit
            assert min(steps, low) - rounding <= new_steps <= max(steps, high) + rounding
        assert max(weight, 1) <= new_weight <= 255
    assert abs(new_steps) <= MAX_STEPS
    assert 0 <= new_intensity <= 255
    channels = [(int(color) >> shift) & 0x3FF for shift in (20, 10, 0)]
    assert int(color) >> 30 == 0
    assert all(channel <= 1020 for channel in channels)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 20_000), st.integers(-4 * MAX_STEPS, 4 * MAX_STEPS), st.integers(1, 255), st.integers(1, 255))
def test_merged_sums_of_many_maps_saturate(maps, steps, weight, shade):
    one = np.ones((1, 512), np.int64)
    sums = BlockSums(
        np.zeros((1, 3), np.int32), maps * weight * one, maps * weight * steps * one, maps * weight * one,
        maps * weight * shade * one, maps * weight * one, maps * weight * 1020 * np.ones((1, 512, 3), np.int64),
        np.zeros(1, np.int64),
    )  # fmt: skip
    out = fused(sums, MAX_STEPS, 64, 2**40)  # never free space
    found = unpacked(out.geometry[0, 0])
    assert found == (np.clip(steps, -MAX_STEPS, MAX_STEPS), min(maps * weight, MAX_COUNT), shade)
    assert (out.colors[0, 0] >> 20) & 0x3FF == 1020


def test_sums_are_wide_enough_to_be_added():
    coords = np.zeros((1, 3), np.int32)
    sums, one = BlockSums.zeros(coords), BlockSums.zeros(coords)
    one.color[:], one.weight[:], one.distance[:] = 2**20 * 255 * 1020, 2**20 * 255, 2**20 * 255 * -MAX_STEPS
    for _ in range(20):
        sums.add(np.arange(1), one)
    assert sums.color.min() == 20 * 2**20 * 255 * 1020
    assert sums.weight.min() == 20 * 2**20 * 255
    assert sums.distance.max() == 20 * 2**20 * 255 * -MAX_STEPS


@pytest.mark.parametrize("operation", [lambda x: 1 / x, lambda x: np.log(x - 1), lambda x: np.exp(x + 1000)])
def test_float_errors_are_errors_in_tests(operation):
    with pytest.raises(FloatingPointError):
        operation(np.zeros(3))
    with ThreadPoolExecutor(1) as pool, pytest.raises((FloatingPointError, RuntimeWarning)):
        pool.submit(operation, np.zeros(3)).result()


# -- far from the origin -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames():
    camera = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
    sequence = synthetic.sequence("room", movers=(), frames=15, camera=camera, noise="kinect", seed=4)
    Ts = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
    return Ts[:, :3, 3], camera, [sequence[index] for index in range(len(sequence))]


def run_from(place, camera, frames, monkeypatch):
    """Poses relative to the first, and the mesh, of a run that begins at a place (3,)."""
    T = np.eye(4)
    T[:3, 3] = place
    start = classmethod(lambda cls, gain, _: cls(TrackingResult(T, (gain, 0.0), ACCEPTED, 1.0, 0.0, 1.0, 0)))
    monkeypatch.setattr(PoseEstimate, "at_origin", start)
    slam = Slam(camera, CONFIG)
    results = [slam.process(frame) for frame in frames]
    assert all(result.T_world_camera is not None for result in results)
    return np.array([se3.inverse(T) @ result.T_world_camera for result in results]), slam.volume.extract_mesh()


def test_a_camera_ten_kilometres_away_is_as_accurate(frames, monkeypatch):
    block = 8 * CONFIG.volume.voxel_size
    truth, camera, images = frames
    near, near_mesh = run_from(np.zeros(3), camera, images, monkeypatch)
    error = np.linalg.norm(near[:, :3, 3] - truth, axis=1)
    for step in (LOCAL_GRID, 1):  # at a local origin, and anywhere
        place = block * step * np.rint(FAR / (block * step))
        assert np.linalg.norm(place) > 9900
        far, far_mesh = run_from(place, camera, images, monkeypatch)
        far_error = np.linalg.norm(far[:, :3, 3] - truth, axis=1)
        assert np.sqrt(np.mean(far_error**2)) < np.sqrt(np.mean(error**2)) + 1e-3
        if step > 1:  # elsewhere poses scatter by what rounding does to them at the origin, too
            assert np.abs(far - near).max() < 1e-3
        vertices = far_mesh.vertices.astype(np.float64) - place
        distance, _ = cKDTree(near_mesh.vertices).query(vertices)
        assert abs(len(far_mesh.vertices) - len(near_mesh.vertices)) < 0.02 * len(near_mesh.vertices)
        assert np.median(distance) < 1e-3


def test_free_space_ten_kilometres_away_is_seen_as_at_the_origin():
    camera, block, known = Camera(131.25, 131.25, 79.5, 59.5, 160, 120), 8 * CONFIG.volume.voxel_size, []
    wall = Frame(0.0, np.full(camera.shape, 3, np.float32), np.full((*camera.shape, 3), 120, np.uint8))
    for place in (np.zeros(3), block * LOCAL_GRID * np.rint(FAR / (block * LOCAL_GRID))):
        volume, T = TsdfVolume(camera, CONFIG.volume, CONFIG.sensor, depth_max=4.0), np.eye(4)
        T[:3, 3] = place
        for _ in range(2 * CONFIG.volume.free_after):
            volume.integrate(wall, T)
        known.append(volume.blocks.num_free(volume.config.free_after))
    assert known[1] == known[0] > 100
