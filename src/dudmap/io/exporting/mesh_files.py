"""Mesh files (PLY, OBJ, STL, binary glTF 2.0, USDZ) and point clouds of the vertices (PLY, PCD, LAZ, E57).

GLB, OBJ and USDZ take a texture. glTF has linear vertex colours and an unlit material, which trimesh lacks.
"""

import json
import struct
import tempfile
from dataclasses import replace
from importlib import import_module
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file, atomic_path, put_in_place, write_bytes, write_text
from dudmap.core.geometry.mesh import Mesh
from dudmap.extras import extra
from dudmap.io.exporting.gravity import y_up
from dudmap.io.exporting.mesh_editing import edited, rotated
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.up import up_of

if TYPE_CHECKING:
    from dudmap.io.texturing.baking import TexturedMesh

FLOAT, UINT16, UINT32 = 5126, 5123, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
JPEG_QUALITY = 90
MATERIAL: dict[str, Any] = {
    "name": "recorded colours",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh in map axes: PLY, OBJ or STL by suffix."""
    edited(run.surface, options).save(path)


def write_obj(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write OBJ in map axes, with vertex colours, or with a texture, a .mtl and a .jpg of its name."""
    if options.texture is None:
        return write(run, path, options)
    made = _textured(run, options)
    mesh, material, image = made.mesh, path.with_suffix(".mtl"), path.with_suffix(".jpg")
    places = np.column_stack([made.uv[:, 0], 1 - made.uv[:, 1]])  # v grows upwards
    text = StringIO()
    text.write(f"mtllib {material.name}\nusemtl map\n")
    for name, rows in (("v", mesh.vertices), ("vt", places), ("vn", mesh.normals)):
        np.savetxt(text, rows, fmt=f"{name} " + " ".join(["%.6g"] * rows.shape[1]))
    a, b, c = (mesh.faces.T + 1).tolist()
    text.writelines(f"f {i}/{i}/{i} {j}/{j}/{j} {k}/{k}/{k}\n" for i, j, k in zip(a, b, c, strict=True))
    write_bytes(image, _jpeg(made.image))
    write_text(material, f"newmtl map\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image.name}\n")
    write_text(path, text.getvalue())


def write_glb(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh as binary glTF. Vertices keep map axes; the node turns them to y up."""
    made = None if options.texture is None else _textured(run, options)
    mesh = edited(run.surface, options) if made is None else made.mesh
    T = np.eye(4)
    T[:3, :3] = y_up(up_of(run, options))
    with atomic_file(path) as file:
        file.write(encoded(mesh, T, texture=None if made is None else (made.uv, _jpeg(made.image))))


def _textured(run: RunContent, options: ExportOptions) -> "TexturedMesh":
    from dudmap.io.texturing.baking import textured

    return textured(run, options)


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    import cv2

    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def encoded(
    mesh: Mesh,
    T_gltf_mesh: NDArray[np.float64] | None = None,
    *,
    double_sided: bool = True,
    texture: tuple[NDArray[np.float32], bytes] | None = None,
) -> bytes:
    """Content of a GLB file (glTF 2.0, sections 3 and 4.4).

    Args:
        texture: Places (V, 2) from the upper left corner, and the JPEG file; None for vertex colours.
    """
    from dudmap.version import __version__

    T = np.eye(4) if T_gltf_mesh is None else T_gltf_mesh
    low, high = mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()
    parts: list[tuple[NDArray, int, dict[str, Any]]] = [
        (mesh.vertices.astype("<f4"), VERTEX_BUFFER, {"componentType": FLOAT, "type": "VEC3", "min": low, "max": high}),
        (mesh.normals.astype("<f4"), VERTEX_BUFFER, {"componentType": FLOAT, "type": "VEC3"}),
        (_linear(mesh.colors), VERTEX_BUFFER, {"componentType": UINT16, "type": "VEC4", "normalized": True})
        if texture is None
        else (texture[0].astype("<f4"), VERTEX_BUFFER, {"componentType": FLOAT, "type": "VEC2"}),
        (mesh.faces.reshape(-1).astype("<u4"), INDEX_BUFFER, {"componentType": UINT32, "type": "SCALAR"}),
    ]
    accessors, views, start = [], [], 0
    for number, (array, target, accessor) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        accessors.append(accessor | {"bufferView": number, "count": len(array)})
        start += array.nbytes  # all are multiples of 4 bytes
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0" if texture is None else "TEXCOORD_0": 2}
    material, more, image = MATERIAL | {"doubleSided": double_sided}, {}, b""
    if texture is not None:
        image = texture[1] + b"\0" * (-len(texture[1]) % 4)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(texture[1])})
        start += len(image)
        surface = MATERIAL["pbrMetallicRoughness"] | {"baseColorTexture": {"index": 0}}
        material |= {"pbrMetallicRoughness": surface}
        more = {"textures": [{"source": 0}], "images": [{"bufferView": len(parts), "mimeType": "image/jpeg"}]}
    tree = {
        "asset": {"version": "2.0", "generator": f"dudmap {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0, "matrix": T.T.reshape(-1).tolist()}],
        "meshes": [{"name": "map", "primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    } | more
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + start
    head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text
    content = [array.tobytes() for array, _, _ in parts] + [image]
    return b"".join([head, struct.pack("<I4s", start, b"BIN\0"), *content])


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
    """Write the mesh as USDZ, y up, metres, with ``displayColor`` or a texture."""
    with extra("export", "writing .usdz"):
        # by name, because type checkers see no classes of usd-core
        sdf, usd, geom, utils, vt = (import_module(f"pxr.{n}") for n in ("Sdf", "Usd", "UsdGeom", "UsdUtils", "Vt"))
    made = None if options.texture is None else _textured(run, options)
    mesh = rotated(edited(run.surface, options) if made is None else made.mesh, y_up(up_of(run, options)))
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
        if made is None:
            colors = prim.CreateDisplayColorPrimvar(geom.Tokens.vertex)
            colors.Set(vt.Vec3fArray.FromNumpy(linear_light(mesh.colors).astype(np.float32)))
        else:
            write_bytes(Path(folder) / "map.jpg", _jpeg(made.image), sync=False)
            _usd_material(stage, prim, sdf, vt, made.uv)
        stage.Save()
        packed = Path(folder) / "packed.usdz"
        if not utils.CreateNewUsdzPackage(sdf.AssetPath(str(layer)), str(packed)):
            raise OSError(f"usd-core could not write {path}")
        put_in_place(packed, path)


def _usd_material(stage: Any, prim: Any, sdf: Any, vt: Any, uv: NDArray[np.float32]) -> None:  # noqa: ANN401 - of USD
    geom, shade = import_module("pxr.UsdGeom"), import_module("pxr.UsdShade")
    places = np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(np.float32)  # v grows upwards
    st = geom.PrimvarsAPI(prim).CreatePrimvar("st", sdf.ValueTypeNames.TexCoord2fArray, geom.Tokens.vertex)
    st.Set(vt.Vec2fArray.FromNumpy(places))
    material, token = shade.Material.Define(stage, "/map/material"), sdf.ValueTypeNames.Token
    reader, texture, surface = (shade.Shader.Define(stage, f"/map/material/{n}") for n in ("st", "image", "surface"))
    for shader, kind in (
        (reader, "UsdPrimvarReader_float2"),
        (texture, "UsdUVTexture"),
        (surface, "UsdPreviewSurface"),
    ):
        shader.CreateIdAttr(kind)
    reader.CreateInput("varname", sdf.ValueTypeNames.String).Set("st")
    texture.CreateInput("file", sdf.ValueTypeNames.Asset).Set("map.jpg")
    texture.CreateInput("sourceColorSpace", token).Set("sRGB")
    result = reader.CreateOutput("result", sdf.ValueTypeNames.Float2)
    texture.CreateInput("st", sdf.ValueTypeNames.Float2).ConnectToSource(result)
    rgb = texture.CreateOutput("rgb", sdf.ValueTypeNames.Float3)
    surface.CreateInput("emissiveColor", sdf.ValueTypeNames.Color3f).ConnectToSource(rgb)
    surface.CreateInput("diffuseColor", sdf.ValueTypeNames.Color3f).Set((0, 0, 0))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", token))
    shade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)


LAS_STEP = 0.0001
"""Resolution of LAS coordinates, metres."""


def _points(run: RunContent, options: ExportOptions) -> Mesh:
    mesh = edited(run.surface, options)
    return replace(mesh, faces=np.empty((0, 3), np.int32))


def write_ply(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write binary PLY with normals and colours."""
    _points(run, options).save(path)


def write_pcd(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write binary PCD 0.7 with x y z rgb normal_x normal_y normal_z; rgb is packed into a float, as PCL expects."""
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
