"""Colours of a map that are taken from another one."""

import numpy as np

import dudmap.lab.synthetic
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume

CAMERA = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)


def voxels(volume: TsdfVolume) -> dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]:
    """Packed geometry and colour of every block by its coordinates."""
    blocks = volume.blocks
    return {
        tuple(blocks.slot_coords[slot]): (blocks.geometry[slot].copy(), blocks.colors[slot].copy())
        for slot in volume.active_slots
    }


def test_colours_are_those_of_the_other_map_and_the_geometry_stays():
    room = dudmap.lab.synthetic.sequence(movers=(), frames=2, camera=CAMERA, noise="none")
    T = room.ground_truth.Ts_world_camera
    here, other = TsdfVolume(CAMERA), TsdfVolume(CAMERA)
    for n in (0, 0, 1):
        here.integrate(room[n], T[n])
    half = np.zeros(CAMERA.shape, bool)
    half[:, :80] = True
    inverted = Frame(0.0, room[0].depth, 255 - room[0].color)
    other.integrate(inverted, T[0], half)
    before, painted, count = voxels(here), voxels(other), here.num_integrated
    here.take_colors(other)
    after = voxels(here)
    assert before.keys() == after.keys()
    for place, (geometry, color) in after.items():
        assert np.array_equal(geometry >> 8, before[place][0] >> 8)  # distance and weight
        expected, tint = painted.get(place, (np.zeros_like(geometry), np.zeros_like(color)))
        assert np.array_equal(geometry & 0xFF, expected & 0xFF)
        assert np.array_equal(color, tint)
    assert any((color == 0).all() for _, color in after.values())  # what the other has not seen
    assert len(here.written_since(count)[0]) == len(after)
    here.integrate(room[0], T[0])  # such voxels take the colour of the next reading
    mesh = here.extract_mesh(1)
    assert len(mesh.vertices) > 0
    assert (mesh.colors.max(axis=1) > 0).mean() > 0.95
