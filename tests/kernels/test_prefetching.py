"""Loads of pairs of words, and the blocks that the fusion leaves as they are."""

import numpy as np
from numba import njit

from dudmap.config import VolumeConfig
from dudmap.core.backends.cpu.memory import load_pair
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume


@njit
def loaded(words, index):
    return load_pair(words, np.uintp(index))  # pyright: ignore[reportCallIssue]


def test_a_pair_is_two_consecutive_words():
    words = np.random.default_rng(0).integers(-(2**31), 2**31, 100).astype(np.int32)
    for index in range(99):  # odd ones too, where the pair does not lie as a 64-bit number would
        assert np.array_equal(np.array([loaded(words, index)]).view(np.int32), words[index : index + 2])


def test_what_lies_behind_the_band_of_all_readings_stays_as_it_is():
    """A wall at 2 m, in blocks from 1.92 m on; then an image of a wall at 1.82 m alone, whose band ends at 1.90 m."""
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    volume = TsdfVolume(camera, VolumeConfig(voxel_size=0.02, take_turns=False), depth_max=4.0)
    color = np.full((48, 64, 3), 200, np.uint8)
    volume.integrate(Frame(0.0, np.full((48, 64), 2, np.float32), color), np.eye(4))
    slots = volume.active_slots
    geometry, colors = volume.blocks.geometry[slots].copy(), volume.blocks.colors[slots].copy()
    volume.integrate(Frame(1.0, np.full((48, 64), 1.82, np.float32), color), np.eye(4))
    assert np.all(volume.blocks.entry_of[slots] >= 0)
    assert volume.blocks.fused[slots].max() == 2  # the image was compared with them
    assert np.array_equal(volume.blocks.geometry[slots], geometry)
    assert np.array_equal(volume.blocks.colors[slots], colors)
    assert len(volume.active_slots) > len(slots)
