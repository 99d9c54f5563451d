"""A coloured mesh as a binary glTF 2.0 file in memory.

trimesh writes the same, but takes milliseconds of Python per call; a growing map is sent in hundreds of small parts,
while the thread of the run waits for the interpreter.
"""

import json
import struct

import numpy as np

from dudmap.core.geometry.mesh import Mesh

_FLOAT, _SHORT, _INDEX = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963

_SRGB = np.arange(256) / 255
LINEAR = np.rint(65535 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)).astype("<u2")
"""Linear intensity, 0 to 65535, of an sRGB value 0 to 255 (IEC 61966-2-1): glTF has linear vertex colours."""


def glb(mesh: Mesh) -> bytes:
    """The mesh with normals and colours, seen from its front side only; positions in the frame of the mesh.

    The material is unlit (KHR_materials_unlit): the colours are shown as the camera saw them.
    """
    opaque = np.full((len(mesh.vertices), 4), 65535, dtype="<u2")
    opaque[:, :3] = LINEAR[mesh.colors]
    parts = [
        (mesh.vertices.astype("<f4"), _FLOAT, "VEC3", _VERTICES),
        (mesh.normals.astype("<f4"), _FLOAT, "VEC3", _VERTICES),
        (opaque, _SHORT, "VEC4", _VERTICES),
        (mesh.faces.astype("<u4").reshape(-1), _INDEX, "SCALAR", _INDICES),
    ]
    views, accessors, offset = [], [], 0
    for array, kind, shape, target in parts:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape})
        offset += array.nbytes
    accessors[0] |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    accessors[2]["normalized"] = True
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
    material = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicFactor": 0.0}}
    tree = {
        "asset": {"version": "2.0", "generator": "dudmap"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(tree).encode("ascii")
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for array, *_ in parts)  # all parts are multiples of 4 bytes long
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
