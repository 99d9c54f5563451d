"""Loose pieces of a mesh that an export leaves out."""

import numpy as np

from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions


def triangle(size: float, x: float) -> Mesh:
    vertices = np.array([[x, 0, 0], [x + size, 0, 0], [x, size, 0]], np.float32)
    return Mesh(vertices, np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8), np.zeros((3, 3), np.float32))


def test_pieces_less_than_two_centimetres_across_are_left_out_unless_all_are_wanted():
    whole = joined([triangle(0.01, 0.0), triangle(0.5, 1.0), triangle(0.015, 2.0), triangle(0.001, 3.0)])
    kept = edited(whole, ExportOptions())
    np.testing.assert_array_equal(kept.vertices, whole.vertices[3:9])
    assert len(kept.faces) == 2
    assert len(edited(whole, ExportOptions(drop_pieces_below=0.0)).faces) == 4
