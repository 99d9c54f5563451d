"""Ranges: a scene that is smaller or larger than a room, seen by a camera whose noise is so in proportion."""

from dataclasses import replace

import numpy as np
import pytest

from dudmap.config import Config, keys
from dudmap.config_section import ConfigSection
from dudmap.core.frames.frame import Frame
from dudmap.core.slam import Slam
from dudmap.errors import ConfigError
from dudmap.lab import synthetic
from dudmap.ranges import POWERS, RANGES, scaled

LENGTHS = "metres", "m/s", "1/m"
"""Units in the docstrings of parameters that have a length in them."""


def frames_of(size: float, movers: tuple[str, ...] = (), count: int = 30) -> tuple[Slam, list[Frame], np.ndarray]:
    """A system with the parameters for a desk of a ``size``, its frames, and its true positions (N, 3)."""
    desk = synthetic.sequence("desk", movers=movers, frames=count, camera=(160, 120), seed=5)
    frames = [replace(frame, depth=frame.depth * np.float32(size)) for frame in map(desk.__getitem__, range(count))]
    assert desk.ground_truth is not None
    truth = np.linalg.inv(desk.ground_truth.Ts_world_camera[0]) @ desk.ground_truth.Ts_world_camera
    return Slam(desk.camera, Config.from_tree({}, size)), frames, size * truth[:, :3, 3]


def test_a_room_keeps_its_values():
    assert Config.from_tree({}, 1.0) == Config.for_range("room") == Config()


def test_all_parameters_with_a_length_are_scaled():
    known = {f"{section}.{key}" for section, powers in POWERS.items() for key in powers}
    described = set()
    for name, section in Config.model_fields.items():
        if name != "thesis" and isinstance(section.default, ConfigSection):  # the baseline knows rooms only
            for key, field in type(section.default).model_fields.items():
                if any(unit in (field.description or "") for unit in LENGTHS):
                    described.add(f"{name}.{key}")
    assert described <= known
    assert known <= set(keys())


@pytest.mark.parametrize("size", [*RANGES.values(), 5.0])
def test_the_noise_grows_with_the_scene(size: float):
    room, other = Config(), Config.from_tree({}, size)
    for z in (0.4, 1.0, 5.0):
        assert other.sensor.sigma(size * z) == pytest.approx(size * room.sensor.sigma(z), rel=0.01)
    assert other.preprocess.depth_max / other.volume.voxel_size == pytest.approx(600, rel=0.01)


def test_what_is_given_is_not_scaled():
    given = Config.from_tree({"volume": {"voxel_size": 0.004}}, 0.2)
    assert given.volume.voxel_size == 0.004
    assert given.preprocess.depth_max == 1.2
    assert Config.from_tree(Config().model_dump(), 0.2) == Config()  # a stored configuration names everything
    with pytest.raises(ConfigError, match="near"):
        Config.for_range("close")


@pytest.mark.parametrize("size", [0.2, 2.5])
def test_a_scaled_scene_is_tracked_as_a_room(size: float):
    """Tracked frames, errors, mesh and labels agree with the room."""
    results = {}
    for factor in (1.0, size):
        slam, frames, truth = frames_of(factor, movers=("person",))
        found = [slam.process(frame) for frame in frames]
        assert [result.status for result in found] == ["tracked"] * len(frames)
        poses = np.array([result.T_world_camera for result in found])
        positions = poses[:, :3, 3] / factor
        error = np.linalg.norm(positions - truth / factor, axis=1)
        shares = np.array([result.dynamic_share for result in found])
        results[factor] = error, len(slam.maps[0][1].extract_mesh().faces), shares
    (room_error, room_faces, room_shares), (error, faces, shares) = results[1.0], results[size]
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.sqrt(np.mean(room_error**2)) + 1e-4
    assert faces == pytest.approx(room_faces, rel=0.1)
    assert np.abs(shares - room_shares).mean() < 0.03


def test_sizes_that_are_scaled_twice_agree_with_one_scale():
    tree = Config().model_dump()
    once, twice = scaled(tree, 0.4), scaled(scaled(tree, 2.0), 0.2)
    assert once["volume"] == twice["volume"]
