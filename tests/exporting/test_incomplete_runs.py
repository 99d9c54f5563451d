"""``dudmap export`` of run folders that lack something, or that a later version has written."""

import json

import numpy as np
import pytest

import dudmap
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, MapError
from dudmap.io.exporting.exporters import export_run
from dudmap.io.exporting.run_content import ExportOptions


def test_incomplete_and_newer_run_folders(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    Trajectory(np.array([1.0]), np.eye(4)[None]).save(folder / "trajectory.txt")
    with pytest.raises(MapError, match=r"holds no mesh\.ply"):
        export_run(folder, tmp_path / "map.ply")
    points = np.zeros((3, 3), np.float32)
    Mesh(points, np.empty((0, 3), np.int32), points.astype(np.uint8), points).save(folder / "mesh.ply")
    with pytest.raises(MapError, match="has no triangles"):
        export_run(folder, tmp_path / "map.ply")
    Mesh(points + np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), points.astype(np.uint8), points).save(
        folder / "mesh.ply"
    )
    with pytest.raises(MapError, match=r"holds no map\.npz"):
        export_run(folder, tmp_path / "map.npz", ExportOptions(up=(0, -1, 0)))
    whole = (folder / "mesh.ply").read_bytes()
    (folder / "mesh.ply").write_bytes(whole[:-3])
    with pytest.raises(MapError, match="cut off or damaged"):
        export_run(folder, tmp_path / "map.ply")
    (folder / "mesh.ply").write_bytes(whole)
    (folder / "metrics.json").write_text(json.dumps({"versions": {"dudmap": "99.1.0"}}))
    with pytest.raises(DatasetError, match=rf"was written by dudmap 99\.1\.0 and this is {dudmap.__version__}"):
        export_run(folder, tmp_path / "map.ply")
