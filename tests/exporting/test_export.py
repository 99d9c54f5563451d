"""``dudmap export``: what is written is read back by the format's own library."""

import json
import sys

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.io.exporting import ros_messages as ros
from dudmap.io.exporting.exporters import EXPORTERS, export_run


def grid_mesh(n=40, step=0.01):
    """A plane of n x n vertices."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32) * step
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate(
        [np.stack([first, first + n, first + 1], 1), np.stack([first + 1, first + n, first + n + 1], 1)]
    )
    normals = np.tile(np.array([0, 0, 1], np.float32), (n * n, 1))
    return Mesh(vertices, faces.astype(np.int32), np.full((n * n, 3), 60, np.uint8), normals)


@pytest.fixture
def run_folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    Ts = np.stack([se3.exp(np.array([0.1 * k, 0, 0, 0, 0, 0])) for k in range(4)])
    Trajectory(np.array([100.0, 100.1, 100.2, 100.4]), Ts).save(folder / "trajectory.txt")
    grid_mesh().save(folder / "mesh.ply")
    line = {"timestamp": 100.1, "movers": [{"id": 2, "box": [[0, 0, 1], [1, 1, 2]]}]}
    (folder / "movers.jsonl").write_text(json.dumps(line) + "\n")
    return folder


def read(path):
    """Messages by topic, with their times in seconds."""
    out = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        for connection, stamp, raw in reader.messages():
            out.setdefault(connection.topic, []).append((stamp / 1e9, reader.deserialize(raw, connection.msgtype)))
    return out


def test_an_mcap_file_holds_the_run(run_folder, tmp_path):
    path = export_run(run_folder, tmp_path / "run.mcap")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["run", "run.mcap"]
    found = read(path)
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/path": 1, "/points": 1, "/mesh": 1, "/tf": 4, "/odometry": 4, "/movers": 2,
    }  # fmt: skip
    np.testing.assert_allclose([stamp for stamp, _ in found["/tf"]], [100.0, 100.1, 100.2, 100.4])
    np.testing.assert_allclose(
        [message.transforms[0].transform.translation.x for _, message in found["/tf"]], [0, 0.1, 0.2, 0.3], atol=1e-8
    )
    np.testing.assert_allclose(
        [message.twist.twist.linear.x for _, message in found["/odometry"]], [0, 1, 1, 0.5], atol=1e-5
    )
    assert len(found["/path"][0][1].poses) == 4
    cloud = found["/points"][0][1]
    assert np.frombuffer(cloud.data.tobytes(), ros.POINT)["x"].max() == np.float32(0.39)
    assert len(found["/mesh"][0][1].points) == 3 * len(grid_mesh().faces)
    assert [len(message.markers) for _, message in found["/movers"]] == [2, 1]


def test_an_older_file_is_replaced(run_folder, tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"old")
    assert "/tf" in read(export_run(run_folder, tmp_path / "run.mcap"))


def test_a_run_without_a_mesh_is_written(run_folder, tmp_path):
    (run_folder / "mesh.ply").unlink()
    (run_folder / "movers.jsonl").unlink()
    assert set(read(export_run(run_folder, tmp_path / "way.mcap"))) == {"/path", "/tf", "/odometry"}


def test_bad_input_is_refused(run_folder, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"cannot export to 'run\.bag'; the ending or name must be one of \.ply"):
        export_run(run_folder, tmp_path / "run.bag")
    with pytest.raises(DatasetError, match=r"holds no trajectory\.txt; name a run folder"):
        export_run(tmp_path, tmp_path / "run.mcap")
    (run_folder / "movers.jsonl").write_text("{")
    with pytest.raises(DatasetError, match=r"movers\.jsonl is damaged"):
        export_run(run_folder, tmp_path / "run.mcap")
    (run_folder / "movers.jsonl").unlink()
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(ConfigError, match=r'needs the extra ros-bags .*; pip install "\.\[ros-bags\]"'):
        export_run(run_folder, tmp_path / "run.mcap")


def test_every_exporter_can_be_imported():
    assert all(callable(exporter.write) for exporter in EXPORTERS.values())


def test_simplified_meshes_keep_their_shape():
    mesh = grid_mesh()
    coarse = simplified(mesh, 400)
    assert 100 < len(coarse.faces) <= 400
    assert coarse.area() == pytest.approx(mesh.area(), rel=0.25)
    assert (coarse.colors == 60).all()
    np.testing.assert_allclose(coarse.normals, np.tile([0, 0, 1], (len(coarse.vertices), 1)))
    assert simplified(mesh, 10**6) is mesh


def test_folders_of_the_target_are_made(run_folder, tmp_path):
    assert export_run(run_folder, tmp_path / "new" / "folder" / "run.mcap").is_file()
