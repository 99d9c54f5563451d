"""USDZ files."""

import tempfile
from importlib import import_module
from pathlib import Path

import numpy as np

from dudmap.atomic_file import put_in_place
from dudmap.extras import extra
from dudmap.io.exporting.gltf import linear_light
from dudmap.io.exporting.gravity import up_of, y_up
from dudmap.io.exporting.mesh_editing import edited, rotated
from dudmap.io.exporting.options import ExportOptions
from dudmap.io.exporting.run_content import RunContent

MODULES = "Sdf", "Usd", "UsdGeom", "UsdUtils", "Vt"
"""Modules of usd-core, imported by name: they give their classes at run time only, and type checkers see none."""


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh of a run, y up, metres, with its colours as ``displayColor``."""
    with extra("export", "writing .usdz"):
        sdf, usd, geom, utils, vt = (
            import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom", "UsdUtils", "Vt")
        )
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
