"""Which direction is up: cameras held upright, rolled by 90 degrees and upside down in a room whose up is known."""

import numpy as np
import pytest
import trimesh

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError
from dudmap.io.exporting.exporters import export_run
from dudmap.io.exporting.mesh_editing import without_small_pieces
from dudmap.io.exporting.run_content import ExportOptions
from dudmap.io.exporting.up import find_up
from dudmap.io.sequences.gravity import Gravity
from exported_runs import make_run

UP = np.array([0.0, 0.0, 1.0])


def plane(origin, along, across, step=0.1):
    """Vertices and normals of triangles, three by three, of a rectangle that faces along x across."""
    n, m = (round(float(np.linalg.norm(edge)) / step) for edge in (along, across))
    i, j = (part.reshape(-1, 1) for part in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    corners = [(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)]
    parts = [origin + (i + a) / n * np.array(along) + (j + b) / m * np.array(across) for a, b in corners]
    vertices = np.stack(parts, axis=1).reshape(-1, 3)
    normal = np.cross(along, across) / np.linalg.norm(np.cross(along, across))
    return vertices, np.tile(normal, (len(vertices), 1))


def room():
    """Floor, table, part of the ceiling and four walls, seen from inside; z up."""
    parts = [
        plane((0, 0, 0), (4, 0, 0), (0, 3, 0)),
        plane((1, 1, 0.7), (1.5, 0, 0), (0, 0.8, 0)),
        plane((0, 0, 2.5), (0, 1, 0), (4, 0, 0)),
        plane((0, 0, 0), (0, 0, 2), (4, 0, 0)),
        plane((0, 3, 0), (4, 0, 0), (0, 0, 2)),
        plane((0, 0, 0), (0, 3, 0), (0, 0, 2)),
        plane((4, 0, 0), (0, 0, 2), (0, 3, 0)),
    ]
    vertices, normals = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return vertices, normals, faces


def scanned(roll, turn, pitch=20.0):
    """Mesh and poses of a scan in the world of its first camera, which is rolled; and the true direction there."""
    Ts = []
    for yaw in np.radians(np.linspace(0, turn, 40)):
        forward = np.array([np.cos(yaw), np.sin(yaw), -np.tan(np.radians(pitch))])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, UP)
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1) @ turned(roll)
        T[:3, 3] = 2.0 + 0.1 * np.cos(yaw), 1.5 + 0.1 * np.sin(yaw), 1.4
        Ts.append(T)
    vertices, normals, faces = room()
    T = se3.inverse(Ts[0])
    vertices, normals = vertices @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
    mesh = Mesh(vertices.astype(np.float32), faces, np.full(vertices.shape, 90, np.uint8), normals.astype(np.float32))
    return mesh, Trajectory(np.arange(40) / 10, T @ np.array(Ts)), T[:3, :3] @ UP


def turned(roll):
    """Rotation (3, 3) about the optical axis, degrees."""
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def angle(one, other):
    return np.degrees(np.arccos(np.clip(np.dot(one, other), -1, 1)))


def named(sentence):
    """Direction that a sentence names after --up."""
    numbers = sentence.partition("--up ")[2].partition(" or ")[0]
    return np.array(numbers.split(","), float)


@pytest.mark.parametrize("turn", [60, 300])
def test_an_upright_camera_is_assumed_and_not_doubted(turn):
    mesh, poses, true = scanned(0, turn)
    up = find_up(mesh, poses)
    assert (up.source, up.contradiction) == ("floor", "")
    assert "assumed: the camera is upright" in up.evidence
    assert angle(up.direction, true) < 0.1
    assert up.sigma_deg < 1
    assert up.floor.height == pytest.approx(-1.4, abs=0.01)  # the first camera is 1.4 m above it


@pytest.mark.parametrize("turn", [60, 300])
def test_an_upside_down_camera_is_noticed(turn):
    mesh, poses, true = scanned(180, turn)
    up = find_up(mesh, poses)
    assert "upside down" in up.contradiction
    assert angle(named(up.contradiction), true) < 1


@pytest.mark.parametrize("roll", [90, -90])
def test_a_camera_rolled_by_90_degrees_is_noticed_by_its_turn(roll):
    mesh, poses, true = scanned(roll, 300)
    up = find_up(mesh, poses)
    assert "rolled" in up.contradiction
    assert abs(named(up.contradiction) @ true) > 0.99


@pytest.mark.parametrize("roll", [90, -90])
def test_a_rolled_camera_that_sees_the_floor_at_its_side_is_noticed(roll):
    mesh, poses, true = scanned(roll, 20)
    level = mesh.faces[(mesh.normals[mesh.faces[:, 0]] @ true) > 0.9]
    up = find_up(Mesh(mesh.vertices, level, mesh.colors, mesh.normals), poses)
    assert "rolled by 90 degrees" in up.contradiction
    assert angle(named(up.contradiction), true) < 1


@pytest.mark.parametrize("roll", [0, 90, 180])
def test_measured_gravity_needs_no_upright_camera(roll):
    mesh, poses, true = scanned(roll, 60)
    skewed = se3.exp_rotation(np.radians(2) * np.array([1.0, 0, 0])) @ true  # an IMU mounted 2 degrees off
    ups = skewed @ poses.Ts_world_camera[:, :3, :3]
    measured = Gravity(poses.timestamps, ups, "/imu").in_world(poses)
    assert measured.sigma_deg < 0.01
    up = find_up(mesh, poses, measured)
    assert up.source == "gravity"
    assert angle(up.direction, true) < 0.1  # the floor refines it
    assert up.floor.height == pytest.approx(-1.4, abs=0.01)
    assert ("degrees off the gravity" in up.contradiction) == (roll != 0)


def test_gravity_that_contradicts_the_poses_is_not_used():
    mesh, poses, _ = scanned(0, 300)
    steady = np.tile([0.0, -0.9, 0.436], (40, 1))  # does not turn with the camera, whose pitch is another one
    steady[::2] = 1.0, 0.0, 0.0
    up = find_up(mesh, poses, Gravity(poses.timestamps, steady, "/imu").in_world(poses))
    assert up.source == "floor"
    assert "not used" in up.contradiction


def test_a_given_direction_that_contradicts_gravity_is_taken_and_said():
    mesh, poses, true = scanned(0, 60)
    measured = Gravity(poses.timestamps, true @ poses.Ts_world_camera[:, :3, :3], "odometry.csv").in_world(poses)
    up = find_up(mesh, poses, measured, tuple(-true))
    assert up.source == "given"
    assert "180 degrees off the gravity of odometry.csv" in up.contradiction


def test_nav2_does_not_map_the_ceiling_of_an_upside_down_camera(tmp_path):
    _, T_map_true = make_run(tmp_path)
    run = tmp_path / "run"
    poses = Trajectory.load(run / "trajectory.txt")
    T = np.eye(4)
    T[:3, :3] = turned(180)
    Trajectory(poses.timestamps, poses.Ts_world_camera @ T).save(run / "trajectory.txt")  # the same map, camera rolled
    with pytest.raises(ConfigError, match=r"may be upside down.*the other way round") as caught:
        export_run(run, tmp_path / "map.yaml")
    assert not (tmp_path / "map.yaml").exists()
    direction = named(str(caught.value))
    assert angle(direction, T_map_true[:3, 2]) < 5
    export_run(run, tmp_path / "map.yaml", ExportOptions(up=tuple(direction)))
    assert "# up: given" in (tmp_path / "map.yaml").read_text()


@pytest.mark.parametrize("name", ["mesh.ply", "points.points.ply", "path.tum"])
def test_surface_and_trajectory_with_z_up(tmp_path_factory, tmp_path, name):
    where = tmp_path_factory.getbasetemp() / "z-up"
    truth = where / "truth.npy"
    if not truth.exists():
        sequence, T_map_true = make_run(where)
        np.save(truth, T_map_true)
        sequence.ground_truth.save(where / "true.txt")
    T_map_true, poses = np.load(truth), Trajectory.load(where / "true.txt")
    export_run(where / "run", tmp_path / name, ExportOptions(z_up=True))
    if name.endswith("tum"):
        found = Trajectory.load(tmp_path / name).Ts_world_camera
        heights, true = found[:, 2, 3], poses.Ts_world_camera[:, 2, 3]
        np.testing.assert_allclose(found[0, :2, 3], 0, atol=0.1)
        assert found[0, 0, 2] > 0.5  # the first camera looks along x
    else:
        heights = np.asarray(trimesh.load(tmp_path / name, process=False).vertices)[:, 2]
        mesh = without_small_pieces(Mesh.load(where / "run/mesh.ply"))
        true = ((mesh.vertices - T_map_true[:3, 3]) @ T_map_true[:3, :3])[:, 2]
    np.testing.assert_allclose(heights, true, atol=0.06)
    with pytest.raises(ConfigError, match="add --z-up"):
        export_run(where / "run", tmp_path / name, ExportOptions(up=(0, -1, 0)))
