"""Textured meshes, against walls whose colours are known everywhere."""

import json
import zipfile

import cv2
import numpy as np
import pygltflib
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdShade
from typer.testing import CliRunner

from dudmap.app.pipeline.image_keeper import ImageKeeper
from dudmap.app.pipeline.run_folder import prepare_run_folder
from dudmap.cli import app
from dudmap.core.backends.cpu.texturing import draw_triangles
from dudmap.errors import ConfigError, NoImagesError
from dudmap.io.exporting.exporters import export_run
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.sequences import open_sequence
from dudmap.io.texturing.baking import textured
from textured_room import BACK, READOUT, RED, SIDE, truth, write

SIZE = 512


def made(run, **options):
    options = {"texture": SIZE, "sequence": run.parent / "recording"} | options
    return textured(RunContent.load(run), ExportOptions(**options))


def samples(mesh, count=20_000):
    """Random points (n, 3) of the surface, their colours in the texture (n, 3), and those by vertex colours (n, 3)."""
    random = np.random.default_rng(0)
    surface = mesh.mesh
    corners = surface.vertices[surface.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = random.choice(len(areas), count, p=areas / areas.sum())
    shares = random.dirichlet((1, 1, 1), count)
    points, places, colors = (
        np.einsum("nk,nkc->nc", shares, values[surface.faces[chosen]].astype(np.float64))
        for values in (surface.vertices, mesh.uv, surface.colors)
    )
    u, v = (places * len(mesh.image) - 0.5).astype(np.float32).T.reshape(2, -1, 100).copy()
    found = cv2.remap(mesh.image, u, v, cv2.INTER_LINEAR).reshape(-1, 3)
    return points, found.astype(np.float64), colors


def in_view(points):
    """Points that every camera sees well inside of its image."""
    x, y, z = points.T
    return (np.abs(y) < 0.45) & (x > -0.5) & (z > 1.45)


@pytest.mark.parametrize(("lens", "readout"), [(False, 0.0), (True, READOUT)])
def test_texels_have_the_colours_of_the_walls(tmp_path, lens, readout):
    points, found, by_vertices = samples(made(write(tmp_path, lens=lens, readout=readout)))
    inner = in_view(points) & (points[:, 0] < SIDE - 0.05) | in_view(points) & (points[:, 2] < BACK - 0.05)
    gain = np.median(truth(points[inner]) / found[inner], axis=0)  # the exposure of the map is free
    error = np.sqrt(np.mean((found[inner] * gain - truth(points[inner])) ** 2))
    plain = np.sqrt(np.mean((by_vertices[inner] - truth(points[inner])) ** 2))
    assert error < 6 < plain / 3


def test_exposures_leave_no_seams(tmp_path):
    """Means over 12 cm, a period of the pattern, differ from the truth by one factor only."""
    points, found, _ = samples(made(write(tmp_path)), 60_000)
    used = in_view(points) & (points[:, 2] > BACK - 1e-3) & (points[:, 0] < SIDE - 0.06)
    cell = np.floor(points[used, :2] / 0.12).astype(int) @ (1, 1000)
    _, cell = np.unique(cell, return_inverse=True)
    means = [np.bincount(cell, values[used].mean(axis=1)) / np.bincount(cell) for values in (found, truth(points))]
    ratio = means[0] / means[1]
    assert np.std(ratio[np.bincount(cell) > 50]) < 0.03  # of exposures that differ by a factor of 1.5


@pytest.mark.parametrize("masked", [True, False])
def test_nothing_of_an_occluder_is_left(tmp_path, masked):
    """By its mask, or by its depth if the mask misses it."""
    points, found, _ = samples(made(write(tmp_path, screen=True, masked=masked)))
    inner = in_view(points)
    redness = found[inner, 0] - found[inner, 1:].max(axis=1)
    wanted = truth(points[inner])
    expected = wanted[:, 0] - wanted[:, 1:].max(axis=1)
    assert RED[0] - RED[1] > 200
    assert np.max(redness - expected) < 40


def test_texels_that_no_view_shows_take_vertex_colours(tmp_path):
    result = made(write(tmp_path))
    points, found, _ = samples(result)
    unseen = points[:, 0] < -1.35  # left of every view
    assert 0.3 < result.seen < 0.95
    assert np.abs(found[unseen] - truth(points[unseen])).mean() < 45  # of the pattern, no black
    assert found[unseen].min() > 20


def test_triangles_are_drawn_as_a_plain_loop_says():
    random = np.random.default_rng(3)
    points = np.column_stack([random.uniform(-5, 45, (30, 2)), random.uniform(0.5, 3, 30)]).astype(np.float32)
    faces = random.permutation(30).reshape(10, 3).astype(np.int32)
    numbers, depth = np.full((32, 40), -1, np.int32), np.full((32, 40), np.inf, np.float32)
    draw_triangles(points, faces, np.float32(0), numbers, depth)
    v, u = np.mgrid[0:32, 0:40]
    wanted, nearest = np.full((32, 40), -1), np.full((32, 40), np.inf)
    for number, face in enumerate(faces):
        corners = np.vstack([points[face, :2].T.astype(float), np.ones(3)])
        shares = np.linalg.solve(corners, np.stack([u.ravel(), v.ravel(), np.ones(u.size)])).reshape(3, 32, 40)
        z = 1 / np.einsum("k,kyx->yx", 1 / points[face, 2], shares)
        nearer = (shares.min(axis=0) >= 0) & (z < nearest)
        wanted[nearer], nearest[nearer] = number, z[nearer]
    assert np.mean(numbers != wanted) < 0.005  # pixels on an edge
    same = (numbers == wanted) & (wanted >= 0)
    assert same.sum() > 300
    np.testing.assert_allclose(depth[same], nearest[same], rtol=1e-3)


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write(tmp_path_factory.mktemp("textured"))


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_other_programs_read_the_texture(run, tmp_path, ending):
    path = tmp_path / f"room{ending}"
    export_run(run, path, ExportOptions(texture=SIZE, sequence=run.parent / "recording"))
    mesh = trimesh.load(path, process=False, force="mesh")
    material = mesh.visual.material
    image = np.asarray(material.baseColorTexture if ending == ".glb" else material.image)
    assert image.shape == (SIZE, SIZE, 3)
    corners = mesh.triangles.mean(axis=1)
    if ending == ".glb":  # its node turns the mesh to y up
        corners = corners @ np.diag([1, -1, -1]) if abs(corners[:, 2].min()) > abs(corners[:, 2].max()) else corners
    places = mesh.visual.uv[mesh.faces].mean(axis=1)  # trimesh counts v upwards for both
    u, v = places[:, 0] * SIZE - 0.5, (1 - places[:, 1]) * SIZE - 0.5
    found = cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR).reshape(-1, 3)
    inner = in_view(corners)
    wanted = truth(corners[inner])
    gain = np.median(wanted / found[inner], axis=0)
    assert inner.sum() > 100
    assert np.sqrt(np.mean((found[inner] * gain - wanted) ** 2)) < 12


def test_usdz_holds_the_texture(run, tmp_path):
    path = export_run(run, tmp_path / "room.usdz", ExportOptions(texture=SIZE, sequence=run.parent / "recording"))
    with zipfile.ZipFile(path) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".jpg"))
        image = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (SIZE, SIZE, 3)
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/map")
    places = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
    assert len(places) == len(UsdGeom.Mesh(prim).GetPointsAttr().Get())
    assert 0 <= places.min() <= places.max() <= 1
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"


def test_a_run_without_images_says_so_and_has_vertex_colours(run, tmp_path):
    out = tmp_path / "room.glb"
    with pytest.raises(NoImagesError, match="--save-images"):
        export_run(run, out, ExportOptions(texture=SIZE))
    done = CliRunner().invoke(app, ["export", str(run), "--out", str(out), "--texture", "--json"])
    assert done.exit_code == 0, done.output
    assert "warning: " in done.stderr
    assert "--save-images; the mesh is written with vertex colours" in " ".join(done.stderr.split())
    assert json.loads(done.stdout)["texture"] is None
    assert pygltflib.GLTF2().load(str(out)).meshes[0].primitives[0].attributes.COLOR_0 is not None


def test_sizes_and_formats_are_checked(run, tmp_path):
    for options, name, said in (
        ({"texture": 16}, "room.glb", "found a texture of 16 pixels; expected 64 to 8192"),
        ({"texture": SIZE}, "room.stl", "does not take --texture"),
    ):
        with pytest.raises(ConfigError, match=said):
            export_run(run, tmp_path / name, ExportOptions(**options))


def test_kept_images_are_a_recording_and_go_with_the_run(run, tmp_path):
    """Frames from one place are kept once; a new run into the folder removes them."""
    recording = open_sequence(run.parent / "recording")
    poses = RunContent.load(run).trajectory.Ts_world_camera
    for copied in ("mesh.ply", "trajectory.txt", "calibration.toml"):
        (tmp_path / copied).write_bytes((run / copied).read_bytes())
    (tmp_path / "masks").mkdir()
    for mask in (run / "masks").iterdir():
        (tmp_path / "masks" / mask.name).write_bytes(mask.read_bytes())
    keeper = ImageKeeper(recording)

    class Read:
        frame = None

    class Result:
        status, T_world_camera = "tracked", None

    class Slam:
        camera = recording.camera

    keeper.start(Slam, tmp_path, None)
    for number in [*range(len(recording)), len(recording) - 1]:
        read, result = Read(), Result()
        read.frame, result.T_world_camera = recording[number], poses[number]
        keeper.frame(number, read, result, 0.0)
    kept = open_sequence(tmp_path / "images")
    assert len(kept) == len(recording)
    assert kept.camera == recording.camera
    assert np.abs(kept[2].depth - recording[2].depth).max() < 1e-3
    assert np.abs(kept[2].rgb.astype(int) - recording[2].rgb).mean() < 3
    with_kept = textured(RunContent.load(tmp_path), ExportOptions(texture=SIZE))
    assert with_kept.seen == pytest.approx(made(run).seen, abs=0.01)
    prepare_run_folder(tmp_path, None, save_masks=True)
    assert not list((tmp_path / "images").iterdir())
