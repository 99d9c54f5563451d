"""Small pieces of a map that hang in the air are not seen in the views that replace what moves."""

import numpy as np
import pytest

from dudmap.app.views.hanging import hanging, remove_hanging_pieces
from dudmap.config import SensorConfig, VolumeConfig
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.core.map.volume import TsdfVolume

CAMERA = Camera(fx=120, fy=120, cx=79.5, cy=59.5, width=160, height=120)


def square(edge: float, z: float, x: float = 0.0) -> Mesh:
    vertices = np.array([[x, 0, z], [x + edge, 0, z], [x, edge, z], [x + edge, edge, z]], np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    return Mesh(vertices, faces, np.zeros((4, 3), np.uint8), np.zeros((4, 3), np.float32))


def test_only_small_pieces_far_from_larger_ones_hang():
    parts = {
        "wall": square(1.0, 2.0),
        "remains": square(0.04, 1.5),
        "fragment": square(0.04, 1.985),
        "lamp": square(0.06, 1.0),
    }
    found = hanging(joined(list(parts.values()))).reshape(-1, 4).all(axis=1)
    assert dict(zip(parts, found.tolist(), strict=True)) == {
        "wall": False,
        "remains": True,
        "fragment": False,
        "lamp": False,
    }
    assert not hanging(square(0.04, 1.5)).any()  # all there is


@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_what_hangs_is_not_seen_and_all_else_is_as_before(turned):
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.01), SensorConfig())
    depth = np.full((120, 160), 1.5, np.float32)
    depth[58:62, 78:82] = 1.0
    for number in range(4):
        volume.integrate(Frame(number / 30, depth, np.full((120, 160, 3), 90, np.uint8)), np.eye(4))
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turned), 0, np.sin(turned)], [0, 1, 0], [-np.sin(turned), 0, np.cos(turned)]]
    before = volume.raycast(T).depth
    near = (before > 0) & (before < 1.2)
    assert near.any()
    remove_hanging_pieces(volume, volume.extract_mesh())
    after = volume.raycast(T).depth
    assert not ((after > 0) & (after < 1.2)).any()
    np.testing.assert_allclose(after[~near], before[~near], atol=1e-6)
