"""Recordings of a few frames: the mesh holds everything in view."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from dudmap import Camera, Config, Mesh, Slam, TsdfVolume, run, synthetic
from dudmap.app.views.rendering import orbit, render_run
from dudmap.io.exporting.run_content import RunContent

CAMERA = Camera(131.25, 131.25, 79.5, 59.5, 160, 120)
CONFIG = Config().override(["volume.voxel_size=0.03"])


def recording(scene, count, **options):
    """A recording of so many frames, with the noise of a Kinect."""
    return synthetic.sequence(scene, frames=max(count, 2), camera=CAMERA, camera_path="handheld", **options)


def held_share(mesh, sequence, count):
    """Share of the true points of all frames that the mesh shows within two voxels."""
    points = []
    for index in range(count):
        frame, T = sequence[index], sequence.ground_truth.Ts_world_camera[index]
        near = CAMERA.backproject(np.where(frame.depth < 3.5, frame.depth, 0)).reshape(-1, 3)
        points.append(near[near[:, 2] > 0] @ T[:3, :3].T + T[:3, 3])
    T = sequence.ground_truth.Ts_world_camera[0]
    vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    distances, _ = KDTree(vertices).query(np.concatenate(points)[::7])
    return np.mean(distances < 0.06)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_the_mesh_of_few_frames_holds_all_that_they_show(count, tmp_path):
    sequence = recording("desk", count, movers=())
    report = run(sequence, CONFIG, tmp_path / "run", max_frames=count, progress=False)
    metrics = report.metrics
    assert metrics["fused"] + metrics["skipped_similar"] == metrics["tracked"] == count
    mesh = Mesh.load(tmp_path / "run" / "mesh.ply")
    assert held_share(mesh, sequence, count) > 0.95
    content = RunContent.load(tmp_path / "run")
    path = orbit(content, np.array([0.0, -1.0, 0.0]), 20.0, 1, 30.0, CAMERA)
    assert render_run(content, path, tmp_path / "view.png") == 1


@pytest.fixture(scope="module")
def people():
    """Eight frames of a person who walks through a room."""
    sequence = recording("room", 8, start_dynamic=True)
    return [sequence[index] for index in range(8)]


def processed(frames, first_pass=None):
    slam = Slam(CAMERA, CONFIG, first_pass)
    return slam, [slam.process(frame) for frame in frames]


def test_every_frame_of_a_young_map_is_fused(people):
    _, results = processed(people)
    assert all(result.fused for result in results)


def test_two_runs_of_few_frames_are_equal(tmp_path):
    sequence = recording("room", 8, start_dynamic=True)
    for name in ("one", "two"):
        run(sequence, CONFIG, tmp_path / name, progress=False)
    assert (tmp_path / "one" / "mesh.ply").read_bytes() == (tmp_path / "two" / "mesh.ply").read_bytes()
    twice = run(sequence, CONFIG, tmp_path / "passes", progress=False, passes=2)
    assert twice.metrics["mesh_triangles"] > 0


def test_a_stored_map_of_few_frames_gives_the_same_mesh(people, tmp_path):
    slam, _ = processed(people[:1])
    slam.volume.save(tmp_path / "map.npz")
    loaded, mesh = TsdfVolume.load(tmp_path / "map.npz").extract_mesh(), slam.volume.extract_mesh()
    assert len(loaded.faces) == len(mesh.faces) > 500
