"""Point clouds: the vertices of the mesh, which lie on the surface at most one voxel apart, in the axes of the map."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np

from dudmap.atomic_file import atomic_file, atomic_path
from dudmap.core.geometry.mesh import Mesh
from dudmap.extras import extra
from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.run_content import ExportOptions, RunContent

LAS_STEP = 0.0001
"""Resolution of coordinates in LAS files, metres: a hundredth of a voxel."""


def _points(run: RunContent, options: ExportOptions) -> Mesh:
    """The points with their colours and normals."""
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
