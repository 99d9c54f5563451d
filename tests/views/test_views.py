"""Artificial views and recordings without what moves, against the rendered truth of the same places."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.app.views.background import BackgroundRenderer, continued, exposure_gain
from dudmap.app.views.cleaning import clean_recording, unlike, with_shadow
from dudmap.app.views.rendering import EMPTY, orbit, render_run, video_file
from dudmap.cli import app
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import ConfigError, DatasetError
from dudmap.io.exporting.run_content import RunContent
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.images import read_mask
from exported_runs import CAMERA, make_run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    where = tmp_path_factory.mktemp("views")
    sequence, _ = make_run(where, frames=24)
    return where, sequence


@pytest.fixture(scope="module")
def run(made):
    return RunContent.load(made[0] / "run")


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# -- dudmap clean ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cleaned(made, run):
    out = made[0] / "cleaned"
    report = clean_recording(run, open_sequence(made[0] / "recording"), out)
    return out, report


def test_the_cleaned_recording_is_the_static_twin(made, cleaned):
    sequence, (out, report) = made[1], cleaned
    twin, result = sequence.static_twin(), open_sequence(out)
    assert report.frames == len(result) == len(sequence)
    assert report.left_out == ()
    np.testing.assert_array_equal(result.timestamps, sequence.timestamps)
    squares, depths, seen, moving = [], [], 0, 0
    for index in range(0, len(sequence), 3):
        frame, given, truth = result[index], sequence[index], twin[index]
        replaced = read_mask(out / "replaced" / f"{frame.timestamp:.6f}.png")
        unknown = read_mask(out / "unknown" / f"{frame.timestamp:.6f}.png")
        assert replaced[sequence.mask(index)].all()
        np.testing.assert_array_equal(frame.color[~replaced], given.color[~replaced])
        np.testing.assert_allclose(frame.depth[~replaced], given.depth[~replaced], atol=1e-4)
        assert not (unknown & ~replaced).any()
        known = replaced & ~unknown
        assert (frame.depth[known] > 0).all()
        squares.append(((frame.color.astype(float) - truth.color)[known] ** 2).reshape(-1))
        both = known & (truth.depth > 0)
        depths.append(np.abs(frame.depth - truth.depth)[both])
        seen += np.count_nonzero(known)
        moving += np.count_nonzero(replaced)
    assert moving > 5000
    assert seen > 0.7 * moving  # the rest was never seen
    assert 10 * np.log10(255**2 / np.concatenate(squares).mean()) > 24  # 160x120 pixels and voxels of 2 cm
    assert np.median(np.concatenate(depths)) < 0.015


def test_the_cleaned_recording_has_what_other_programs_need(made, cleaned):
    out, _ = cleaned
    names = {path.name for path in out.iterdir()}
    assert names == {
        "rgb", "depth", "replaced", "unknown", "rgb.txt", "depth.txt", "replaced.txt", "unknown.txt",
        "associations.txt", "intrinsics.txt", "groundtruth.txt", "trajectory.txt",
    }  # fmt: skip
    assert open_sequence(out).camera == open_sequence(made[0] / "recording").camera


def test_exposure_of_the_frame_is_kept(made, run):
    """A frame that was exposed twice as long gets a background twice as bright."""
    sequence = made[1]
    renderer = BackgroundRenderer(run.volume, CAMERA, CAMERA)
    Ts = run.trajectory.Ts_world_camera
    for index in range(0, 20, 2):
        renderer.add(sequence[index], sequence.mask(index), Ts[index], Ts[index])
    frame, moving = sequence[9], np.zeros(CAMERA.shape, bool)
    moving[40:80, 60:100] = True
    dark = Frame(frame.timestamp, frame.depth, (frame.color // 2).astype(np.uint8))
    as_it_is, seen = renderer.colors(frame, moving, Ts[9])
    half, seen_dark = renderer.colors(dark, moving, Ts[9])
    known = moving & seen & seen_dark
    ratio = as_it_is[known].mean() / half[known].mean()
    assert ratio == pytest.approx(2, rel=0.05)


def test_command_runs_and_cleans(made):
    """Without --run the system itself finds what moves."""
    where, sequence = made
    done = call("clean", where / "recording", where / "own", "--passes", 1, "--json", "--set", "volume.voxel_size=0.02")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["frames"] + len(report["left_out"]) == len(sequence)
    assert (where / "own" / "run" / "mesh.ply").is_file()
    assert len(open_sequence(where / "own")) == report["frames"]


def test_bad_input_is_one_sentence(made, run, cleaned, tmp_path):
    where, _ = made
    done = call("clean", where / "recording", cleaned[0])
    assert done.exit_code == 1
    assert "exists and is not an empty folder" in done.stderr
    bare = tmp_path / "run"
    bare.mkdir()
    for name in ("trajectory.txt", "map.npz", "mesh.ply"):
        (bare / name).write_bytes((where / "run" / name).read_bytes())
    done = call("clean", where / "recording", tmp_path / "out", "--run", bare)
    assert done.exit_code == 1
    assert "repeat the run with --save-masks" in done.stderr.replace("\n", " ")
    later = open_sequence(where / "recording")
    later.timestamps = later.timestamps + 100
    with pytest.raises(DatasetError, match="name the run of this recording"):
        clean_recording(run, later, tmp_path / "out")


def test_only_the_first_frames_are_cleaned(made, run, tmp_path):
    report = clean_recording(run, open_sequence(made[0] / "recording"), tmp_path / "out", max_frames=2)
    assert (report.frames, report.left_out) == (2, ())
    assert len(open_sequence(tmp_path / "out")) == 2


# -- parts -------------------------------------------------------------------------------------------------------------


def test_lens_agrees_with_the_projection_of_points():
    camera = Camera(100.0, 101.0, 62.0, 47.0, 128, 96, distortion=(0.2, -0.1, 0.002, -0.001, 0.05))
    lens = Lens(camera)
    rows, columns = (part.reshape(-1) for part in np.mgrid[5:90:5, 5:120:5])
    z = np.linspace(1, 4, len(rows))
    points = lens.points(rows, columns, z)
    uv, depths = lens.project(points)
    np.testing.assert_allclose(uv, np.stack([columns, rows], 1), atol=0.05)
    np.testing.assert_allclose(depths, z)
    assert (lens.project(-points)[0] == -1).all()
    ramp = np.tile(np.arange(128, dtype=np.float32), (96, 1))
    straight = lens.straight.project(points)
    np.testing.assert_allclose(lens.distorted(ramp)[rows, columns], np.clip(straight[:, 0], 0, 127), atol=0.1)


def test_unknown_colours_continue_what_is_around():
    color = np.zeros((40, 60, 3), np.uint8)
    color[:, :30], color[:, 30:] = (200, 100, 0), (40, 100, 240)
    known = np.ones((40, 60), bool)
    known[10:30, 5:20] = False
    out = continued(np.where(known[..., None], color, 0).astype(np.uint8), known)
    np.testing.assert_array_equal(out[known], color[known])
    assert np.abs(out[10:30, 5:20].astype(int) - (200, 100, 0)).max() < 40
    assert (continued(color, np.zeros_like(known)) == color).all()


def test_shadows_of_the_projector_and_feet_belong_to_what_moves():
    moving, depth = np.zeros((60, 160), bool), np.full((60, 160), 2.0, np.float32)
    moving[10:50, 60:80] = True
    depth[10:50, 50:60] = 0  # the shadow
    depth[5:8, 120:130] = 0  # a hole elsewhere
    depth[20:24, 80:84] = 0  # a hole beside it whose background nobody knows
    behind = np.where(np.arange(160) < 80, 3.0, 0).astype(np.float32) * np.ones((60, 1), np.float32)
    found = with_shadow(moving, depth, behind)
    expected = moving.copy()
    expected[10:50, 50:60] = True
    np.testing.assert_array_equal(found, expected)

    rng = np.random.default_rng(0)
    expected = rng.integers(80, 160, (60, 160, 3)).astype(np.uint8)
    image = np.clip(expected + rng.normal(0, 6, expected.shape), 0, 255).astype(np.uint8)
    image[40:50, 82:90] = 20  # a shoe
    image[30, 100:130] = 20  # an edge that is a pixel off
    where = np.zeros((60, 160), bool)
    where[5:55, 80:140] = True
    left = unlike(image, expected, where)
    assert left[40:50, 82:90].all()
    assert not left[30, 100:130].any()
    assert left.sum() < 150
    image[5:55, 80:130] = 20  # most of what is asked: usual is what the depth confirms
    surely = np.zeros_like(where)
    surely[5:55, 132:140] = True
    assert unlike(image, expected, where, surely)[5:55, 80:130].mean() > 0.98
    assert not unlike(image, expected, np.zeros_like(where)).any()


def test_gain_needs_enough_pixels():
    image, rendered = np.full((30, 30, 3), 120, np.uint8), np.full((30, 30, 3), 80, np.uint8)
    np.testing.assert_allclose(exposure_gain(image, rendered, np.ones((30, 30), bool)), 1.5)
    np.testing.assert_allclose(exposure_gain(image, rendered, np.eye(30) > 0), 1.0)


# -- dudmap render -----------------------------------------------------------------------------------------------------


def test_views_from_the_trajectory_are_the_static_scene(made, run, tmp_path):
    where, sequence = made
    done = call("render", where / "run", "--trajectory", where / "run" / "trajectory.txt", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    result, twin = open_sequence(tmp_path / "out"), sequence.static_twin()
    assert len(result) == len(sequence)
    frame, truth = result[10], twin[10]
    both = (frame.depth > 0) & (truth.depth > 0)
    assert both.mean() > 0.6
    assert np.median(np.abs(frame.depth - truth.depth)[both]) < 0.015
    assert np.median(np.abs(frame.color.astype(int) - truth.color)[both]) < 15


@pytest.mark.parametrize("ending", [".mp4", ".avi"])
def test_videos_can_be_played(made, run, tmp_path, ending):
    path = tmp_path / f"orbit{ending}"
    done = call("render", made[0] / "run", "--orbit", "--max-frames", 6, "--size", "96x64", "--out", path)
    assert done.exit_code == 0, done.output
    video = cv2.VideoCapture(str(path))
    images = [video.read()[1] for _ in range(6)]
    assert not video.read()[0]
    assert images[0].shape == (64, 96, 3)
    assert np.std(images[3]) > 10
    assert np.abs(images[0].astype(int) - images[2]).mean() > 2


def test_a_picture_needs_no_trajectory(made, run, tmp_path):
    path = tmp_path / "map.png"
    done = call("render", made[0] / "run", "--size", "96x64", "--out", path)
    assert done.exit_code == 0, done.output
    picture = cv2.imread(str(path))
    assert picture.shape == (64, 96, 3)
    assert np.std(picture) > 10


@pytest.mark.parametrize("sweep", [60, 360])
def test_an_orbit_holds_98_percent_of_the_surface_upright_and_is_no_farther_than_that_takes(run, sweep):
    up, full, tight = np.array([0.0, -1.0, 0.0]), [], []
    a, b, c = (run.surface.vertices[run.surface.faces[:, k]].astype(float) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    for T in orbit(run, up, sweep, 8, 30, CAMERA).Ts_world_camera:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        assert -T[:3, 1] @ up > 0.3
        x, y, z = (((a + b + c) / 3 - T[:3, 3]) @ T[:3, :3]).T
        seen = np.maximum(np.abs(x / z) * CAMERA.fx / CAMERA.width, np.abs(y / z) * CAMERA.fy / CAMERA.height)
        for shares, reach in ((full, 0.5), (tight, 0.44)):
            shares.append(area[(z > 0) & (seen < reach)].sum() / area.sum())
    assert min(full) > 0.98
    assert min(tight) < 0.98


def test_an_orbit_of_a_camera_that_looked_straight_down_is_upright(run):
    up = run.trajectory.Ts_world_camera[:, :3, 2].mean(axis=0)
    up /= -np.linalg.norm(up)
    for T in orbit(run, up, 60, 3, 30, CAMERA).Ts_world_camera:
        assert -T[:3, 1] @ up > 0.3


def test_a_picture_of_the_whole_map_is_not_cut_off_where_the_readings_ended(made, tmp_path):
    path = tmp_path / "map.png"
    assert call("render", made[0] / "run", "--out", path).exit_code == 0
    filled = (cv2.imread(str(path)) != EMPTY).any(axis=2)
    assert filled.shape == (720, 1280)
    assert filled.mean() > 0.2
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert len(rows) > 0.8 * 720 or len(columns) > 0.8 * 1280


def test_bad_targets_are_one_sentence(made, run, tmp_path):
    where, _ = made
    done = call("render", where / "run", "--out", tmp_path / "a.mp4")
    assert done.exit_code == 1
    assert "name either a --trajectory or --orbit" in done.stderr
    with pytest.raises(ConfigError, match=r"the ending must be one of \.mp4, \.avi"):
        video_file(tmp_path / "a.mov", (64, 48), 30).__enter__()
    with pytest.raises(DatasetError, match="exists and is not an empty folder"):
        render_run(run, Trajectory(np.array([0.0]), np.eye(4)[None]), where)
