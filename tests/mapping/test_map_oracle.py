"""The map's kernels against plain NumPy: fusion, sampling, hashing, windows, free space, files."""

import numpy as np
import pytest

from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.backends.cpu import fusion
from dudmap.core.backends.cpu.visibility import SETTLED
from dudmap.core.backends.parameters import SensorNoise
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import FREE, TsdfVolume
from dudmap.core.map.voxel_blocks import MAX_LOAD
from dudmap.errors import MapError
from oracle import fuse, trilinear
from wavy_wall import CAMERA, CONSTANT, box_before_wall, wall


def poses(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [se3.exp(rng.normal(0, 0.03, 6)) for _ in range(count)]


def voxels_of(volume: TsdfVolume) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """World points, distances, weights and colours of all voxels of a volume."""
    slots = volume.active_slots
    words, colors = volume.blocks.geometry[slots].reshape(-1), volume.blocks.colors[slots].reshape(-1)
    local = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = (volume.blocks.slot_coords[slots][:, None, :] * 8 + local[None]).reshape(-1, 3) * volume.voxel_size
    rgb = np.stack([(colors >> 20) & 1023, (colors >> 10) & 1023, colors & 1023], axis=1) / 4
    return points, (words >> 16) * volume.sdf_unit, (words >> 8) & 255, rgb


def intensity(volume: TsdfVolume) -> np.ndarray:
    """Intensities (n,) 0..255 of all voxels."""
    return volume.blocks.geometry[volume.active_slots].reshape(-1) & 255


def reading_weights(depth, camera, sensor):
    noise = SensorNoise(sensor.sigma_base, sensor.sigma_scale)
    return fusion.reading_weights(depth, camera.intrinsics, noise)


def allowed(volume: TsdfVolume) -> float:
    """Rounding of a distance, metres: two steps of the stored one, half a step of the reading's 65534 in its range."""
    return 2 * volume.sdf_unit + volume.depth_max / 65534 / 2 + 1e-6


def test_integrate_equals_the_running_average_of_the_thesis():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=4.0)
    frames, Ts = [wall(1.5, seed) for seed in range(3)], poses(3)
    for frame, T in zip(frames, Ts, strict=True):
        volume.integrate(frame, T)
    points, distance, weight, color = voxels_of(volume)
    chosen = np.random.default_rng(2).choice(np.flatnonzero(weight == 3), 1500, replace=False)
    expected, weights, colors = fuse(
        frames, [se3.inverse(T) for T in Ts], CAMERA, points[chosen], volume.truncation, volume.truncation_behind, 255
    )
    same_pixel = weights == 3  # float32 and float64 may round a projection to neighbouring pixels
    assert same_pixel.mean() > 0.98
    error = np.abs(distance[chosen] - expected)[same_pixel]
    assert np.mean(error < allowed(volume)) > 0.98
    near = same_pixel & (np.abs(expected) < 1.5 * volume.voxel_size)
    assert np.mean(np.abs(color[chosen] - colors)[near].max(axis=1) < 1.0) > 0.97
    band = same_pixel & (np.abs(expected) < 0.9 * volume.truncation)
    assert np.mean(np.abs(intensity(volume)[chosen] - colors @ [0.299, 0.587, 0.114])[band] < 1.5) > 0.97


def test_integrate_with_angle_weights_and_a_band_that_grows_with_the_noise():
    config = VolumeConfig(voxel_size=0.05, truncation_noise=3.0, truncation_voxels=2, carve_rate=1)
    sensor = SensorConfig(sigma_base=0.001, sigma_scale=0.06)
    volume = TsdfVolume(CAMERA, config, sensor, depth_max=4.0)
    frames, Ts = [wall(distance, seed, bump=0.08) for seed, distance in enumerate((0.8, 0.85, 0.8))], poses(3)
    for frame, T in zip(frames, Ts, strict=True):
        volume.integrate(frame, T)
    gains = [reading_weights(frame.depth, volume.camera, volume.sensor) for frame in frames]
    assert len(np.unique(gains)) >= 3
    sigma = lambda z: 3.0 * (0.001 + 0.06 * z**2)  # noqa: E731
    assert sigma(0.8) > 1.1 * volume.truncation
    points, distance, weight, color = voxels_of(volume)
    chosen = np.random.default_rng(2).choice(np.flatnonzero(weight > 4), 1000, replace=False)
    inverse = [se3.inverse(T) for T in Ts]
    expected, weights, colors = fuse(
        frames, inverse, CAMERA, points[chosen], volume.truncation, volume.truncation_behind, 255, sigma, gains
    )
    same_pixel = weights == weight[chosen]
    assert same_pixel.mean() > 0.98
    assert np.mean(np.abs(distance[chosen] - expected)[same_pixel] < allowed(volume)) > 0.98
    assert np.nanmax(expected) > 1.1 * volume.truncation
    near = same_pixel & (np.abs(expected) < 0.35 * sigma(0.8))
    assert np.mean(np.abs(color[chosen] - colors)[near].max(axis=1) < 1.0) > 0.97


@pytest.mark.parametrize("tilt_deg", [0, 30, 60])
def test_weights_are_the_cosine_over_the_error(tilt_deg):
    """Eq. 4.20 on a plane, whose angle to every ray is known, with a frontal reading at one metre as 4."""
    sensor, camera = SensorConfig(sigma_base=0.001, sigma_scale=0.002), Camera(300.0, 290.0, 31.5, 23.5, 64, 48)
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(camera.shape)], axis=-1)
    for distance in (0.6, 1.0, 2.0):
        depth = distance * np.cos(tilt) / (rays @ normal)
        cosine = (rays @ normal) / np.linalg.norm(rays, axis=-1)
        exact = np.clip(4 * cosine * 0.003 / (0.001 + 0.002 * depth**2), 1, 16)
        found = reading_weights(depth.astype(np.float32), camera, sensor)
        assert np.abs(found - exact)[1:-1, 1:-1].max() <= 0.52  # rounded to whole numbers
    jump = np.where(u < 32, 0.5, 1.5).astype(np.float32)
    jump[10, 10] = 0
    found = reading_weights(jump, camera, sensor)
    assert found[24, 31] == round(4 * 0.3 * 0.003 / 0.0015)  # at a depth edge the angle is not known: taken as slanted
    assert found[10, 10] == 0


def test_far_blocks_that_take_turns_hold_what_they_would_without():
    """Two walls: in front of the nearer one the noise is finer than the voxels, in front of the other it is not."""
    config = VolumeConfig(voxel_size=0.05, weighting="constant", carving=False)
    sensor = SensorConfig(sigma_base=0.001, sigma_scale=0.03)  # three sigma are four voxels at 1.47 m
    frame, volumes = wall(1.2), []
    frame.depth[:, 32:] += 1.3
    for take_turns in (True, False):
        volume = TsdfVolume(CAMERA, config.model_copy(update={"take_turns": take_turns}), sensor, depth_max=4.0)
        for _ in range(SETTLED):
            volume.integrate(frame, np.eye(4))
        before, settled = set(volume.active_slots.tolist()), volume.num_integrated
        written = []
        for number in range(2):
            volume.integrate(frame, np.eye(4))
            written.append(set(volume.written_since(settled + number)[0].tolist()))
        volumes.append((volume, before, written))
    (turns, before, (first, second)), (every, *_) = volumes
    assert before <= first | second  # each in one frame or the other, the near ones in both
    depth = (turns.blocks.slot_coords[:, 2] + 0.5) * turns.block_size
    near = {slot for slot in before if depth[slot] < 1.4}
    assert near <= first & second
    assert 0.4 * len(before - near) < len(first - second) < 0.6 * len(before - near)
    places, distance, weight, _ = voxels_of(turns)
    places_every, distance_every, weight_every, _ = voxels_of(every)
    assert np.array_equal(places, places_every)
    assert np.array_equal(weight, weight_every)
    assert np.abs(distance - distance_every).max() < allowed(turns)


@pytest.mark.parametrize(("carving", "carve_rate", "within"), [(False, 1, 2.0), (True, 1, 2.0), (True, 4, 0.5)])
def test_the_order_of_frames_does_not_matter_below_the_weight_cap(carving, carve_rate, within):
    """Carving faster than fusing depends on the order where a frame sees emptiness: at the rim of the band only."""
    frames, Ts = [wall(1.5, seed) for seed in range(4)], poses(4)
    config = CONSTANT.model_copy(update={"carving": carving, "carve_rate": carve_rate})
    maps = []
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        volume = TsdfVolume(CAMERA, config, depth_max=4.0)
        volume.integrate(frames[0], Ts[0])  # the same blocks exist before either order begins
        volume.integrate(frames[3], Ts[3])
        for index in order:
            volume.integrate(frames[index], Ts[index])
        points, distance, weight, _ = voxels_of(volume)
        keys = map(tuple, np.round(points / volume.voxel_size).astype(int))
        maps.append({key: (d, w) for key, d, w in zip(keys, distance, weight, strict=True) if w >= 4})
    near = within * volume.truncation
    shared = [key for key in maps[0].keys() & maps[1].keys() if abs(maps[0][key][0]) < near]
    assert len(shared) > 1500
    assert max(abs(maps[0][key][0] - maps[1][key][0]) for key in shared) < 1e-3


def test_weights_stop_at_the_cap():
    volume = TsdfVolume(CAMERA, CONSTANT.model_copy(update={"max_weight": 3}), depth_max=4.0)
    for _ in range(6):
        volume.integrate(wall(1.5), np.eye(4))
    assert voxels_of(volume)[2].max() == 3


def test_poor_readings_give_way_to_better_ones(monkeypatch):
    """Twenty poor readings, five good ones a little nearer, and poor ones again, which a good average withstands."""
    config = CONSTANT.model_copy(update={"max_readings": 4})
    volume = TsdfVolume(CAMERA, config, depth_max=4.0)
    (T,), poor, good = poses(1), wall(1.5), wall(1.5)
    good.depth[:] -= 0.02
    frames, gains = [poor] * 20 + [good] * 5 + [poor] * 3, [1] * 20 + [5] * 5 + [1] * 3
    weights_of = [np.full(CAMERA.shape, gain, dtype=np.uint8) for gain in gains]
    for frame, weights in zip(frames, weights_of, strict=True):
        view = volume._view

        def weighted(*arguments, view=view, weights=weights):
            return view(*arguments)._replace(weights=weights)

        with monkeypatch.context() as patch:
            patch.setattr(volume, "_view", weighted)
            volume.integrate(frame, T)
    points, distance, weight, _ = voxels_of(volume)
    chosen = np.random.default_rng(2).choice(np.flatnonzero(weight > 0), 1000, replace=False)
    expected, weights, _ = fuse(
        frames, [se3.inverse(T)] * len(frames), CAMERA, points[chosen], volume.truncation, volume.truncation_behind,
        255, weights_of=weights_of, max_readings=4,
    )  # fmt: skip
    seen = weights == weight[chosen]
    assert seen.mean() > 0.98
    assert set(np.unique(weights[seen])) == {4, 20}, "behind the better wall's band only poor readings count"
    assert (
        np.mean(np.abs(distance[chosen] - expected)[seen] < 4 * allowed(volume)) > 0.98
    )  # 28 roundings instead of three


def test_sample_is_trilinear_interpolation():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=4.0)
    volume.integrate(wall(1.5), np.eye(4))
    points, distance, weight, _ = voxels_of(volume)
    field = {
        tuple(key): d if w else np.nan
        for key, d, w in zip(np.round(points / volume.voxel_size).astype(int), distance, weight, strict=True)
    }
    T = se3.exp(np.array([0.01, -0.02, 0.01, 0.01, 0.0, 0.02]))
    volume.look_at(T)
    depth = wall(1.5).depth
    sample = volume.sample(depth, np.zeros_like(depth), CAMERA, T)
    checked = 0
    for v, u in np.random.default_rng(3).integers(0, (48, 64), (300, 2)):
        z = depth[v, u]
        p = T[:3, :3] @ [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z] + T[:3, 3]
        expected = trilinear(lambda *key: field.get(key, np.nan), p / volume.voxel_size)
        if np.isfinite(expected):
            assert sample.distance[v, u] == pytest.approx(expected, abs=2e-4)
            checked += 1
    assert checked > 200


def test_a_black_image_with_valid_depth_changes_the_surface_like_any_other():
    bright, black = wall(1.5), wall(1.5)
    black.color[:] = 0
    maps = []
    for frames in ([bright, bright], [bright, black], [black, black]):
        volume = TsdfVolume(CAMERA, CONSTANT, depth_max=4.0)
        for frame in frames:
            volume.integrate(frame, np.eye(4))
        maps.append(voxels_of(volume))
    for other in maps[1:]:
        assert np.array_equal(maps[0][1], other[1])
        assert np.array_equal(maps[0][2], other[2])
    assert np.array_equal(maps[1][3], maps[0][3])  # black may be a want of light: it paints nothing
    assert not maps[2][3].any()


def test_a_far_journey_leaves_the_map_intact():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=3.0)
    for _ in range(4):
        volume.integrate(wall(1.5), np.eye(4))
    before = volume.extract_mesh()
    away = np.eye(4)
    away[0, 3] = 40.0
    volume.integrate(wall(1.5, 1), away)
    volume.look_at(np.eye(4))
    view = volume.raycast(np.eye(4))
    assert np.median(np.abs(view.depth - wall(1.5).depth)[view.depth > 0]) < 0.01
    after = volume.extract_mesh()
    assert np.count_nonzero(after.vertices[:, 0] < 20) == len(before.vertices)


def test_what_is_seen_to_be_empty_leaves_map_and_mesh():
    volume = TsdfVolume(CAMERA, CONSTANT.model_copy(update={"carve_rate": 4, "voxel_size": 0.02}), depth_max=4.0)
    for _ in range(15):
        volume.integrate(box_before_wall(), np.eye(4))
    assert np.any(np.abs(volume.extract_mesh().vertices[:, 2] - 1.2) < 0.03)
    for _ in range(25):
        volume.integrate(wall(3.0, bump=0.0), np.eye(4))
    mesh = volume.extract_mesh()
    inside = (np.abs(mesh.vertices[:, 0]) < 0.15) & (np.abs(mesh.vertices[:, 1]) < 0.1)
    assert not np.any(inside & (mesh.vertices[:, 2] < 2.5))
    assert volume.blocks.num_free(volume.config.free_after) > 0
    seen = volume.sample(box_before_wall().depth, np.zeros(CAMERA.shape, np.float32), CAMERA, np.eye(4))
    empty = (seen.occupancy == FREE) | (seen.distance > 0.8 * volume.truncation)
    assert np.mean(empty[18:32, 24:41]) > 0.9


def test_blocks_do_not_come_and_go_with_the_noise():
    config, sensor = VolumeConfig(voxel_size=0.02), SensorConfig(sigma_base=0.001, sigma_scale=0.015)
    volume, given = TsdfVolume(CAMERA, config, sensor, depth_max=4.0), []
    give = volume.blocks.allocate
    volume.blocks.allocate = lambda entries, number: given.append(len(entries)) or give(entries, number)
    for number in range(40):
        frame = wall(2.0)
        noise = np.random.default_rng(number).normal(0, 0.05, CAMERA.shape).astype(np.float32)
        volume.integrate(Frame(float(number), frame.depth + noise, frame.color), np.eye(4))
    assert np.mean(given[-10:]) < 0.01 * volume.num_blocks


def test_a_frame_without_readings_leaves_an_empty_map_empty():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=4.0)
    volume.integrate(wall(1.5), np.eye(4), np.zeros(CAMERA.shape, dtype=bool))
    assert volume.is_empty
    assert volume.num_blocks == 0


def test_masked_pixels_change_nothing():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=3.0)
    static = np.ones(CAMERA.shape, dtype=bool)
    static[:, 32:] = False
    volume.integrate(wall(1.5), np.eye(4), static)
    points, _, weight, _ = voxels_of(volume)
    u = points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx
    assert not np.any(weight[u > 33] > 0)


def test_save_and_load_give_an_equal_map(tmp_path):
    volume = TsdfVolume(CAMERA, CONSTANT, SensorConfig(sigma_scale=0.003), depth_max=3.5)
    for index in range(4):
        volume.integrate(wall(1.5, index), np.eye(4))
    volume.save(tmp_path / "map.npz")
    loaded = TsdfVolume.load(tmp_path / "map.npz")
    a, b = volume.extract_mesh(), loaded.extract_mesh()
    assert np.array_equal(a.vertices, b.vertices)
    assert np.array_equal(a.faces, b.faces)
    assert (loaded.config, loaded.sensor, loaded.depth_max) == (volume.config, volume.sensor, volume.depth_max)
    assert loaded.blocks.num_free(loaded.config.free_after) == volume.blocks.num_free(volume.config.free_after)
    loaded.integrate(wall(1.5, 5), np.eye(4))
    volume.integrate(wall(1.5, 5), np.eye(4))
    assert np.array_equal(volume.extract_mesh().vertices, loaded.extract_mesh().vertices)


def test_what_is_no_map_is_refused(tmp_path):
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(MapError, match="not a readable map"):
        TsdfVolume.load(tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(MapError, match="not a readable map"):
        TsdfVolume.load(tmp_path / "other.npz")
    with pytest.raises(MapError, match="empty"):
        TsdfVolume(CAMERA, CONSTANT).extract_mesh()


def test_voxels_too_small_for_the_range_are_refused():
    with pytest.raises(MapError, match="depth_max"):
        TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.001), depth_max=6.0)


def test_images_of_another_size_are_refused():
    frame = Frame(0.0, np.ones((10, 10), np.float32), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(MapError, match="64x48"):
        TsdfVolume(CAMERA, CONSTANT).integrate(frame, np.eye(4))


def test_space_that_was_seen_empty_costs_a_hundredth_of_its_voxels():
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02), depth_max=4.0)
    before = volume.num_bytes
    for _ in range(12):
        volume.integrate(wall(3.5), np.eye(4))
    assert volume.blocks.num_free(volume.config.free_after) > 1.5 * volume.num_blocks
    voxels = 2 * 512 * 4
    index = volume.num_bytes - before - volume.blocks.num_slots * (voxels + 20)
    assert 0 < index <= 0.01 * voxels * volume.blocks.num_entries


def test_an_occupied_block_costs_little_more_than_its_voxels():
    """As many free entries per block as a room has; 4.2 KB of 1024 bytes, with the hash at its emptiest and fullest."""
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.005), depth_max=4.0)
    volume.look_at(np.eye(4))
    known = 0
    for blocks in (4_000, 9_000, 16_000):
        cells = np.arange(known, 3 * blocks, dtype=np.int32)
        volume.window.entries_of(cells, volume.blocks)
        volume.window.allocate(cells[: blocks - volume.num_blocks], volume.blocks, 1)
        known = 3 * blocks
        assert volume.num_blocks == blocks
        assert volume.blocks.num_entries == known
        assert volume.blocks.num_entries <= MAX_LOAD * len(volume.blocks.table)
        assert volume.num_bytes <= 4.2 * 1024 * blocks


def test_the_map_has_an_end_and_says_so():
    volume = TsdfVolume(CAMERA, CONSTANT, depth_max=3.0)
    edge = np.eye(4)
    edge[0, 3] = 0.4 * (1 << 17) - 4.0
    for _ in range(3):
        volume.integrate(wall(1.5), edge)
    assert volume.extract_mesh().vertices[:, 0].min() > 52_000
    edge[0, 3] += 4.0
    with pytest.raises(MapError, match="52429 m from the origin of the map"):
        volume.integrate(wall(1.5), edge)
