"""A mesh as compressed text inside a web page."""

import base64
import gzip
from typing import Any

import numpy as np

from dudmap.core.geometry.mesh import Mesh

STEPS = 65535
"""Steps of a coordinate over the extent of the mesh: 0.15 mm in a map of 10 m."""


def packed(mesh: Mesh) -> tuple[dict[str, Any], str]:
    """Description for the page, and the data as base64 text of a gzip stream.

    The stream holds the positions, uint16 (V, 3), from the corner ``low`` (0) to ``high`` (65535) of the bounding box;
    the colours, uint8 (V, 3); zeros up to a multiple of 4 bytes; and the faces, int32 (F, 3), each index as the
    difference to the one before it, which compresses well. All little-endian.
    """
    low, high = mesh.vertices.min(axis=0).astype(float), mesh.vertices.max(axis=0).astype(float)
    positions = np.rint((mesh.vertices - low) / np.maximum(high - low, 1e-9) * STEPS).astype("<u2")
    steps = np.diff(mesh.faces.reshape(-1), prepend=0).astype("<i4")
    head = positions.tobytes() + mesh.colors.tobytes()
    data = gzip.compress(head + bytes(-len(head) % 4) + steps.tobytes(), compresslevel=6, mtime=0)
    about = {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "low": low.round(6).tolist(),
        "high": high.round(6).tolist(),
    }
    return about, base64.b64encode(data).decode("ascii")
