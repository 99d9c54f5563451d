"""Loose pieces of a mesh that an export leaves out."""

import numpy as np

from dudmap.core.geometry.mesh import Mesh, joined
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions


def strip(length: float, width: float, x: float) -> Mesh:
    vertices = np.array([[x, 0, 0], [x + width, 0, 0], [x, length, 0], [x + width, length, 0]], np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    return Mesh(vertices, faces, np.zeros((4, 3), np.uint8), np.zeros((4, 3), np.float32))


def test_pieces_smaller_than_a_square_of_two_centimetres_are_left_out_unless_all_are_wanted():
    kept = [strip(0.0201, 0.0201, 0.0), strip(0.2, 0.005, 1.0)]  # a square of 2 cm, and a cable
    whole = joined([*kept, strip(0.019, 0.019, 2.0), strip(0.05, 0.007, 3.0), strip(0.001, 0.001, 4.0)])
    np.testing.assert_array_equal(edited(whole, ExportOptions()).vertices, joined(kept).vertices)
    assert len(edited(whole, ExportOptions(drop_pieces_below=0.0)).faces) == len(whole.faces)
