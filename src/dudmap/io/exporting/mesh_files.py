"""Mesh files: PLY, OBJ, STL, binary glTF 2.0 and USDZ; and point clouds, the vertices of the mesh: PLY, PCD, LAZ, E57.

glTF is written here for linear vertex colours with an unlit material, which trimesh lacks.
"""

import json
import struct
import tempfile
from dataclasses import replace
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file, atomic_path, put_in_place
from dudmap.core.geometry.mesh import Mesh
from dudmap.extras import extra
from dudmap.io.exporting.gravity import y_up
from dudmap.io.exporting.mesh_editing import edited, rotated
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.up import up_of

FLOAT, UINT16, UINT32 = 5126, 5123, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
MATERIAL = {
    "name": "recorded colours",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}
"""Colours already contain the light; a program without the extension shows a matt surface."""


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh in the axes of the map, in the format of the file's suffix: PLY, OBJ or STL."""
    edited(run.surface, options).save(path)


def write_glb(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh as binary glTF. Vertices keep the map's axes; the node turns them to y up."""
    mesh = edited(run.surface, options)
    T = np.eye(4)
    T[:3, :3] = y_up(up_of(run, options))
    with atomic_file(path) as file:
        file.write(encoded(mesh, T))


def encoded(mesh: Mesh, T_gltf_mesh: NDArray[np.float64] | None = None, *, double_sided: bool = True) -> bytes:
    """Content of a GLB file (glTF 2.0, sections 3 and 4.4).

    Args:
    """
    from dudmap.version import __version__

    T = np.eye(4) if T_gltf_mesh is None else T_gltf_mesh
    low, high = mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()
    parts: list[tuple[NDArray, int, dict[str, Any]]] = [
        (mesh.vertices.astype("<f4"), VERTEX_BUFFER, {"componentType": FLOAT, "type": "VEC3", "min": low, "max": high}),
        (mesh.normals.astype("<f4"), VERTEX_BUFFER, {"componentType": FLOAT, "type": "VEC3"}),
        (_linear(mesh.colors), VERTEX_BUFFER, {"componentType": UINT16, "type": "VEC4", "normalized": True}),
        (mesh.faces.reshape(-1).astype("<u4"), INDEX_BUFFER, {"componentType": UINT32, "type": "SCALAR"}),
    ]
    accessors, views, start = [], [], 0
    for number, (array, target, accessor) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        accessors.append(accessor | {"bufferView": number, "count": len(array)})
        start += array.nbytes  # all are multiples of 4 bytes
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    tree = {
        "asset": {"version": "2.0", "generator": f"dudmap {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0, "matrix": T.T.reshape(-1).tolist()}],
        "meshes": [{"name": "map", "primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [MATERIAL | {"doubleSided": double_sided}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + start
    head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text
    return b"".join([head, struct.pack("<I4s", start, b"BIN\0"), *(array.tobytes() for array, _, _ in parts)])


def linear_light(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Linear intensities in 0..1 of sRGB bytes (IEC 61966-2-1)."""
    table = np.arange(256) / 255
    table = np.where(table <= 0.04045, table / 12.92, ((table + 0.055) / 1.055) ** 2.4)
    return table[values]


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.uint16]:
    out = np.full((len(colors), 4), 65535, "<u2")
    out[:, :3] = np.rint(65535 * linear_light(np.arange(256, dtype=np.uint8))).astype(np.uint16)[colors]
    return out


def write_usdz(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh as USDZ, y up, metres, with its colours as ``displayColor``."""
    with extra("export", "writing .usdz"):
        # by name, because type checkers see no classes of usd-core
        sdf, usd, geom, utils, vt = (import_module(f"pxr.{n}") for n in ("Sdf", "Usd", "UsdGeom", "UsdUtils", "Vt"))
    mesh = rotated(edited(run.surface, options), y_up(up_of(run, options)))
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
        layer = Path(folder) / "map.usdc"
        stage = usd.Stage.CreateNew(str(layer))
        geom.SetStageUpAxis(stage, geom.Tokens.y)
        geom.SetStageMetersPerUnit(stage, 1.0)
        prim = geom.Mesh.Define(stage, "/map")
        stage.SetDefaultPrim(prim.GetPrim())
        prim.CreatePointsAttr(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices)))
        prim.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals)))
        prim.SetNormalsInterpolation(geom.Tokens.vertex)
        prim.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.faces.reshape(-1)))
        prim.CreateSubdivisionSchemeAttr(geom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        corners = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
        prim.CreateExtentAttr(vt.Vec3fArray.FromNumpy(corners))
        colors = prim.CreateDisplayColorPrimvar(geom.Tokens.vertex)
        colors.Set(vt.Vec3fArray.FromNumpy(linear_light(mesh.colors).astype(np.float32)))
        stage.Save()
        packed = Path(folder) / "packed.usdz"
        if not utils.CreateNewUsdzPackage(sdf.AssetPath(str(layer)), str(packed)):
            raise OSError(f"usd-core could not write {path}")
        put_in_place(packed, path)


LAS_STEP = 0.0001
"""Resolution of coordinates in LAS files, metres: a hundredth of a voxel."""


def _points(run: RunContent, options: ExportOptions) -> Mesh:
    mesh = edited(run.surface, options)
    return replace(mesh, faces=np.empty((0, 3), np.int32))


def write_ply(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write binary PLY with normals and colours."""
    _points(run, options).save(path)


def write_pcd(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write binary PCD 0.7 with the fields x y z rgb normal_x normal_y normal_z; rgb is packed into a float, as PCL
    expects.
    """
    points = _points(run, options)
    row = np.dtype([("xyz", "<f4", 3), ("rgb", "<u4"), ("normal", "<f4", 3)])
    rows = np.empty(len(points.vertices), row)
    red, green, blue = points.colors.astype(np.uint32).T
    rows["xyz"], rows["normal"], rows["rgb"] = points.vertices, points.normals, (red << 16) | (green << 8) | blue
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        "FIELDS x y z rgb normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4 4\nTYPE F F F F F F F\nCOUNT 1 1 1 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    with atomic_file(path) as file:
        file.write(header.encode("ascii") + rows.tobytes())


def write_laz(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write LAS 1.4, point format 7 (colours of 16 bits), compressed."""
    with extra("export", "writing .laz"):
        import laspy
        import lazrs  # noqa: F401 - laspy compresses with it
    points = _points(run, options)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, LAS_STEP), np.floor(points.vertices.min(axis=0)).astype(float)
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.vertices.astype(np.float64).T
    data.red, data.green, data.blue = points.colors.astype(np.uint16).T * 257
    content = BytesIO()
    data.write(content, do_compress=True)
    with atomic_file(path) as file:
        file.write(content.getbuffer())


def write_e57(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write E57 with one scan."""
    with extra("export", "writing .e57"):
        import pye57
    points = _points(run, options)
    x, y, z = points.vertices.astype(np.float64).T
    red, green, blue = points.colors.T
    scan = {"cartesianX": x, "cartesianY": y, "cartesianZ": z, "colorRed": red, "colorGreen": green, "colorBlue": blue}
    with atomic_path(path) as temporary:
        file = pye57.E57(str(temporary), mode="w")
        file.write_scan_raw({name: np.ascontiguousarray(values) for name, values in scan.items()}, name="map")
        file.close()
