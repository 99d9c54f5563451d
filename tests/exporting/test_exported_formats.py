"""Every format of ``dudmap export`` is read back by another program's library, or by a parser written here."""

import json
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import laspy
import numpy as np
import pye57
import pygltflib
import pytest
import trimesh
from PIL import Image
from pxr import Usd, UsdGeom
from ruamel.yaml import YAML
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError, MapError
from dudmap.io.exporting.exporters import EXPORTERS, export_run
from dudmap.io.exporting.mesh_editing import without_small_pieces
from dudmap.io.exporting.mesh_files import linear_light
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.exporting.up import find_floor
from exported_runs import CAMERA, VOXEL, make_run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    where = tmp_path_factory.mktemp("export")
    sequence, T_map_true = make_run(where)
    return where, sequence, T_map_true


@pytest.fixture(scope="module")
def run(made):
    return made[0] / "run"


@pytest.fixture(scope="module")
def mesh(run):
    return without_small_pieces(Mesh.load(run / "mesh.ply"))


@pytest.fixture(scope="module")
def true_up(made):
    return made[2][:3, 2]


def exported(run, path, **options):
    return export_run(run, path, ExportOptions(**options))


# -- meshes ------------------------------------------------------------------------------------------------------------


def test_glb_has_y_up_and_linear_unlit_colours(run, mesh, true_up, tmp_path):
    path = exported(run, tmp_path / "map.glb")
    tree = pygltflib.GLTF2().load(str(path))
    assert tree.materials[0].extensions == {"KHR_materials_unlit": {}}
    assert tree.materials[0].pbrMetallicRoughness.metallicFactor == 0
    primitive = tree.meshes[0].primitives[0]
    view = tree.bufferViews[tree.accessors[primitive.attributes.COLOR_0].bufferView]
    blob = tree.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    colors = np.frombuffer(blob, "<u2").reshape(-1, 4)
    np.testing.assert_allclose(colors[:, :3] / 65535, linear_light(mesh.colors), atol=1e-4)
    assert (colors[:, 3] == 65535).all()

    scene = trimesh.load(path, process=False)
    T = scene.graph.get("map")[0]
    (read,) = scene.geometry.values()
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos((T[:3, :3] @ true_up)[1])) < 1.5  # glTF: +y is up
    assert (T[:3, :3] @ [0, 0, 1])[2] < -0.9  # and the first camera looks along -z


def test_given_up_is_used(run, tmp_path):
    scene = trimesh.load(exported(run, tmp_path / "map.glb", up=(0.0, -2.0, 0.0)))
    np.testing.assert_allclose(scene.graph.get("map")[0], np.diag([1, -1, -1, 1]), atol=1e-12)


def test_ply_obj_and_stl_keep_the_axes_of_the_map(run, mesh, tmp_path):
    read = trimesh.load(exported(run, tmp_path / "map.ply"), process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], mesh.colors)

    lines = exported(run, tmp_path / "map.obj").read_text().splitlines()
    corners = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(corners[:, :3], mesh.vertices, atol=1e-5)
    np.testing.assert_allclose(255 * corners[:, 3:], mesh.colors, atol=0.51)
    assert sum(line.startswith("f ") for line in lines) == len(mesh.faces)

    data = exported(run, tmp_path / "map.stl").read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    rows = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("none", "<u2")]), count, 84)
    np.testing.assert_array_equal(rows["corners"], mesh.vertices[mesh.faces])


def test_usdz_has_metres_and_y_up(run, mesh, true_up, tmp_path):
    path = exported(run, tmp_path / "map.usdz")
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    prim = UsdGeom.Mesh(stage.GetDefaultPrim())
    points = np.array(prim.GetPointsAttr().Get())
    R = np.linalg.lstsq(mesh.vertices, points, rcond=None)[0].T
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-4)
    assert (R @ true_up)[1] > 0.999
    assert len(prim.GetFaceVertexIndicesAttr().Get()) == mesh.faces.size
    np.testing.assert_allclose(prim.GetDisplayColorAttr().Get(), linear_light(mesh.colors), atol=1e-6)
    with zipfile.ZipFile(path) as archive:  # USDZ: stored, never compressed
        assert all(info.compress_type == zipfile.ZIP_STORED for info in archive.infolist())


def test_options_change_the_mesh(run, mesh, tmp_path):
    low, high = np.percentile(mesh.vertices, 20, axis=0), np.percentile(mesh.vertices, 80, axis=0)
    part = trimesh.load(exported(run, tmp_path / "a.ply", crop=(*low.tolist(), *high.tolist())), process=False)
    assert 0 < len(part.faces) < len(mesh.faces)
    assert (part.vertices >= low - 1e-6).all()
    assert (part.vertices <= high + 1e-6).all()
    whole = trimesh.load(run / "mesh.ply", process=False)
    labels = trimesh.graph.connected_component_labels(whole.edges, node_count=len(whole.vertices))[whole.faces[:, 0]]
    large = np.bincount(labels, whole.area_faces)[labels] >= 0.05
    kept = trimesh.load(exported(run, tmp_path / "b.ply", drop_pieces_below=0.05), process=False)
    np.testing.assert_array_equal(kept.triangles, whole.triangles[large])
    assert not large.all()
    coarse = trimesh.load(exported(run, tmp_path / "c.ply", max_triangles=5000), process=False)
    assert 4000 < len(coarse.faces) <= 5000
    assert coarse.area == pytest.approx(whole.area, rel=0.05)


def test_holes_are_closed(tmp_path):
    sphere = trimesh.creation.icosphere(3)
    near = np.arccos(np.clip(sphere.triangles_center @ [0, 0, 1], -1, 1))
    open_faces = sphere.faces[(near > 0.2) & (near < np.pi - 0.8)]  # a small hole above, a large one below
    (tmp_path / "run").mkdir()
    colors = np.full(sphere.vertices.shape, 90, np.uint8)
    Mesh(
        sphere.vertices.astype(np.float32), open_faces.astype(np.int32), colors, sphere.vertices.astype(np.float32)
    ).save(tmp_path / "run" / "mesh.ply")
    Trajectory(np.array([1.0]), np.eye(4)[None]).save(tmp_path / "run" / "trajectory.txt")
    one = trimesh.load(exported(tmp_path / "run", tmp_path / "one.ply", fill_holes=3.0))
    both = trimesh.load(exported(tmp_path / "run", tmp_path / "both.ply", fill_holes=30.0))
    assert not one.is_watertight
    assert len(one.faces) > len(open_faces)
    assert both.is_watertight
    assert both.is_winding_consistent
    assert both.volume == pytest.approx(4 / 3 * np.pi, rel=0.1)


# -- point clouds ------------------------------------------------------------------------------------------------------


def test_point_clouds(run, mesh, tmp_path):
    cloud = trimesh.load(exported(run, tmp_path / "map.points.ply"))
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(cloud.vertices, mesh.vertices)
    np.testing.assert_array_equal(cloud.colors[:, :3], mesh.colors)

    head, _, body = exported(run, tmp_path / "map.pcd").read_bytes().partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in head.decode().splitlines()[1:])
    assert fields["FIELDS"].split() == ["x", "y", "z", "rgb", "normal_x", "normal_y", "normal_z"]
    rows = np.frombuffer(body, "<f4").reshape(int(fields["POINTS"]), 7)
    np.testing.assert_array_equal(rows[:, :3], mesh.vertices)
    packed = np.ascontiguousarray(rows[:, 3]).view(np.uint32)
    np.testing.assert_array_equal(np.stack([packed >> 16, packed >> 8 & 255, packed & 255], 1), mesh.colors)

    las = laspy.read(exported(run, tmp_path / "map.laz"))
    np.testing.assert_allclose(las.xyz, mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], 1) // 257, mesh.colors)

    scan = pye57.E57(str(exported(run, tmp_path / "map.e57"))).read_scan_raw(0)
    np.testing.assert_allclose(scan["cartesianZ"], mesh.vertices[:, 2], atol=1e-6)
    np.testing.assert_array_equal(scan["colorGreen"], mesh.colors[:, 1])


# -- robots ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_grid_agrees_with_what_the_camera_saw(made, run, mesh, tmp_path):
    _, sequence, T_map_true = made
    with np.load(exported(run, tmp_path / "map.npz", resolution=0.04)) as data:
        occupancy, esdf, origin, T_grid_map = (data[key] for key in ("occupancy", "esdf", "origin", "T_grid_map"))
        step = float(data["resolution"])

    def cells(points):
        numbers = np.floor((points @ T_grid_map[:3, :3].T + T_grid_map[:3, 3] - origin) / step).astype(int)
        return tuple(numbers[np.all((numbers >= 0) & (numbers < occupancy.shape), axis=1)].T)

    free = np.stack(np.nonzero(occupancy == 0), axis=1)
    centres = (origin + (free + 0.5) * step - T_grid_map[:3, 3]) @ T_grid_map[:3, :3]
    passed = np.zeros(len(free), bool)
    for number, T_true in enumerate(sequence.ground_truth.Ts_world_camera):
        p = (centres - (T_map_true @ T_true)[:3, 3]) @ (T_map_true @ T_true)[:3, :3]
        u, v = np.rint(CAMERA.project(p)).T
        inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
        exact = sequence.exact_depth(number)[v[inside].astype(int), u[inside].astype(int)]
        passed[inside] |= p[inside, 2] < exact
    assert passed.mean() > 0.99  # a ray of some frame went through every free cell

    T = T_map_true @ sequence.ground_truth.Ts_world_camera[3]
    exact = np.where(sequence.mask(3), 0, sequence.exact_depth(3))
    v, u = (part + start for part, start in zip(np.nonzero(exact[40:80, 50:110]), (40, 50), strict=True))
    halfway = CAMERA.points(u, v, exact[v, u] / 2.0) @ T[:3, :3].T + T[:3, 3]
    assert (occupancy[cells(halfway)] == 0).mean() > 0.9
    assert set(np.unique(occupancy)) == {-1, 0, 100}
    assert (occupancy[cells(mesh.vertices)] == 100).all()

    chosen = np.random.default_rng(0).integers(0, len(free), 60)
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, distances, _ = trimesh.proximity.closest_point_naive(surface, centres[chosen])
    np.testing.assert_allclose(np.abs(esdf[tuple(free[chosen].T)]), distances, atol=VOXEL)
    assert (esdf < 0).any()


def test_floor_is_found(made, run, true_up):
    floor = find_floor(RunContent.load(run), ExportOptions())
    assert np.degrees(np.arccos(floor.up @ true_up)) < 1.5
    assert floor.height == pytest.approx(-1.4, abs=0.06)  # the camera starts 1.4 m above it


def test_nav2_map(made, run, mesh, tmp_path):
    T_map_true = made[2]
    path = exported(run, tmp_path / "map.yaml", heights=(0.2, 1.2))
    tree = YAML(typ="safe").load(path)
    assert {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"} <= set(tree)
    picture = np.array(Image.open(tmp_path / tree["image"]))
    assert set(np.unique(picture)) <= {0, 205, 254}
    row = next(line for line in path.read_text().splitlines() if "motion" in line).partition("rows: ")[2]
    T = np.array(row.split(), float).reshape(4, 4)

    def pixels(points):
        xy = ((points @ T[:3, :3].T + T[:3, 3])[:, :2] - tree["origin"][:2]) / tree["resolution"]
        return picture[picture.shape[0] - 1 - xy[:, 1].astype(int), xy[:, 0].astype(int)]

    true = (mesh.vertices - T_map_true[:3, 3]) @ T_map_true[:3, :3]  # z up, floor at 0
    obstacles = (true[:, 2] > 0.3) & (true[:, 2] < 1.1)
    assert (pixels(mesh.vertices[obstacles]) == 0).mean() > 0.99
    floor = (np.abs(true[:, 2]) < 0.03) & (mesh.normals @ T_map_true[:3, 2] > 0.98)
    assert (pixels(mesh.vertices[floor]) == 254).mean() > 0.7  # the rest lies under furniture and along walls
    with pytest.raises(ConfigError, match=r"the lower one first"):
        exported(run, tmp_path / "map.yaml", heights=(1.0, 0.5))


# -- trajectories ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "ending"), [("tum", ".tum"), ("euroc", ".csv"), ("kitti", ".kitti")])
def test_evo_reads_trajectories(run, tmp_path, kind, ending):
    path = exported(run, tmp_path / f"given{ending}")
    evo = Path(sys.executable).parent / "evo_traj"
    save = "--save_as_kitti" if kind == "kitti" else "--save_as_tum"
    (tmp_path / "out").mkdir()
    subprocess.run([evo, kind, path, save], cwd=tmp_path / "out", check=True, capture_output=True)
    truth = Trajectory.load(run / "trajectory.txt")
    if kind == "kitti":
        rows = np.loadtxt(tmp_path / "out" / "given.kitti")
        np.testing.assert_allclose(rows.reshape(-1, 3, 4), truth.Ts_world_camera[:, :3], atol=1e-6)
        return
    read = Trajectory.load(tmp_path / "out" / "given.tum")
    np.testing.assert_allclose(read.timestamps, truth.timestamps, atol=1e-6)
    np.testing.assert_allclose(read.Ts_world_camera, truth.Ts_world_camera, atol=1e-6)


# -- view synthesis ----------------------------------------------------------------------------------------------------


def depths_of(points, T_camera_world, fl, centre, shape):
    """Nearest depth of points by pixel with the corner of the first pixel as origin; 0 = none (z forward)."""
    p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    u, v = (np.floor(fl[k] * p[:, k] / p[:, 2] + centre[k]).astype(int) for k in range(2))
    seen = (p[:, 2] > 0.2) & (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    out = np.full(shape, np.inf)
    np.minimum.at(out, (v[seen], u[seen]), p[seen, 2])
    return np.where(np.isfinite(out), out, 0)


def agrees(seen, depth, mask):
    both = (seen > 0) & (depth > 0) & (mask == 255)
    return both.sum() > 2000 and np.median(np.abs(seen - depth)[both]) < 0.02


def test_nerfstudio_folder(made, run, tmp_path):
    where, sequence, _ = made
    tree = json.loads(exported(run, tmp_path / "transforms.json", sequence=where / "recording").read_text())
    assert len(tree["frames"]) == len(sequence)
    seeds = trimesh.load(tmp_path / tree["ply_file_path"]).vertices
    for number in (0, 6):
        view = tree["frames"][number]
        depth = np.array(Image.open(tmp_path / view["depth_file_path"])) * tree["depth_unit_scale_factor"]
        mask = np.array(Image.open(tmp_path / view["mask_path"]))
        np.testing.assert_array_equal(mask == 0, sequence.mask(number))
        image = np.array(Image.open(tmp_path / view["file_path"]))
        np.testing.assert_array_equal(image, sequence[number].color)
        T = np.linalg.inv(np.array(view["transform_matrix"]))
        T[1:3] *= -1  # OpenGL looks along -z with y up
        seen = depths_of(seeds, T, (tree["fl_x"], tree["fl_y"]), (tree["cx"], tree["cy"]), (tree["h"], tree["w"]))
        assert agrees(seen, depth, mask)


def test_the_recording_is_the_one_that_the_run_names(made, run, tmp_path):
    where, sequence, _ = made
    metrics = run / "metrics.json"
    before = metrics.read_text() if metrics.is_file() else None
    try:
        metrics.write_text(json.dumps({"recording": {"path": str(where / "recording"), "camera": "90,90,79,59"}}))
        tree = json.loads(exported(run, tmp_path / "transforms.json", every=4).read_text())
        assert len(tree["frames"]) == len(sequence[::4]) if isinstance(sequence, list) else len(tree["frames"]) == 2
        assert tree["fl_x"] == 90  # opened as the run did
        metrics.write_text(json.dumps({"recording": {"path": str(tmp_path / "moved")}}))
        with pytest.raises(DatasetError, match=r"recording cannot be read \(.*moved.*by --sequence"):
            exported(run, tmp_path / "transforms.json")
    finally:
        metrics.unlink() if before is None else metrics.write_text(before)


def test_colmap_folder(made, run, tmp_path):
    where, sequence, _ = made
    exported(run, tmp_path / "cameras.txt", sequence=where / "recording", every=2)
    (line,) = [text.split() for text in (tmp_path / "cameras.txt").read_text().splitlines() if text[0] != "#"]
    assert line[:4] == ["1", "PINHOLE", "160", "120"]
    fx, fy, cx, cy = map(float, line[4:])
    lines = (tmp_path / "images.txt").read_text().splitlines()[1:]
    rows, points2d = lines[::2], lines[1::2]
    assert len(rows) == 4
    assert not any(points2d)
    table = np.loadtxt(tmp_path / "points3D.txt")
    name = rows[2].split()[9]
    w, x, y, z, *t = map(float, rows[2].split()[1:8])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3], t
    seen = depths_of(table[:, 1:4], T, (fx, fy), (cx, cy), (120, 160))
    mask = np.array(Image.open(tmp_path / "masks" / f"{name}.png"))
    assert agrees(seen, sequence[4].depth, mask)
    assert (tmp_path / "images" / name).is_file()


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input_is_one_sentence(made, run, mesh, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"ending or name must be one of \.ply, .*transforms\.json"):
        exported(run, tmp_path / "map.blend")
    with pytest.raises(ConfigError, match=r"map\.stl does not take --resolution; it takes --max-triangles, --crop"):
        exported(run, tmp_path / "map.stl", resolution=0.1)
    with pytest.raises(ConfigError, match="the box of --crop is empty"):
        exported(run, tmp_path / "map.ply", crop=(0, 0, 0, 1, -1, 1))
    with pytest.raises(MapError, match="no triangle of the mesh is left"):
        exported(run, tmp_path / "map.ply", crop=(90, 90, 90, 91, 91, 91))
    with pytest.raises(ConfigError, match="at least the voxel size"):
        exported(run, tmp_path / "map.npz", resolution=0.001)
    with pytest.raises(DatasetError, match="name the recording by --sequence, or repeat the run with --save-images"):
        exported(run, tmp_path / "transforms.json")
    for name, module in ((".laz", "laspy"), (".e57", "pye57"), (".usdz", "pxr.Sdf")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ConfigError, match=r'pip install "\.\[export\]"'):
            exported(run, tmp_path / f"map{name}")
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ConfigError, match=r'^--max-triangles needs the extra export .*"\.\[export\]"'):
        exported(run, tmp_path / "map.ply", max_triangles=100)
    assert list(tmp_path.iterdir()) == []


def test_command(run, tmp_path):
    done = CliRunner().invoke(
        app, ["export", str(run), "--out", str(tmp_path / "a.glb"), "--drop-pieces-below", "0.1", "--up", "0,-1,0"]
    )
    assert done.exit_code == 0, done.output
    assert (tmp_path / "a.glb").is_file()
    done = CliRunner().invoke(app, ["export", str(run), "--out", str(tmp_path / "a.glb"), "--crop", "1,2"])
    assert done.exit_code == 1
    assert "expected 6 numbers separated by commas" in done.stderr


def test_every_format_is_tested_here():
    text = Path(__file__).read_text(encoding="utf-8")
    assert all(f"{name}" in text or name == ".mcap" for name in EXPORTERS)
