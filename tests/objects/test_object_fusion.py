"""Rigid fusion: shape and trajectory of moving objects against the synthetic truth; non-rigid ones are rejected."""

import json

import numpy as np
import pytest
from scipy.optimize import least_squares

import dudmap.lab.synthetic
from dudmap.app.pipeline.run import run
from dudmap.config import Config, SensorConfig, VolumeConfig
from dudmap.core.frames.observation import Level
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.objects.object_fusion import ObjectFusion
from dudmap.core.objects.object_map import ObjectVolume, RigidObject
from dudmap.core.objects.object_tracker import Mover
from dudmap.core.slam import Slam

SMALL = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
ON = Config().override(["movers.meshes=true"])


def fused(sequence, frames):
    """Objects fused from some frames with the true poses and the true masks, by number."""
    fusion, preprocess, last = ObjectFusion(ON), Preprocessor(sequence.camera), {}
    poses = {}
    for i in frames:
        observation = preprocess(sequence[i])
        T = sequence.ground_truth.Ts_world_camera[i]
        poses[observation.timestamp] = T
        depth, intensity = observation.halved(1)
        level = Level(sequence.camera.scaled(1), depth, intensity)
        numbers = sequence.mover_numbers(i)[1::2, 1::2]
        movers = []
        for number in np.unique(numbers[(numbers > 0) & (depth > 0)]):
            mask = (numbers == number) & (depth > 0)
            points = level.camera.backproject(depth)[mask] @ T[:3, :3].T + T[:3, 3]
            centroid = points.mean(axis=0)
            velocity = (centroid - last.get(number, centroid)) * 30
            last[number] = centroid
            box = np.stack([points.min(axis=0), points.max(axis=0)])
            movers.append(Mover(int(number), mask, points, centroid, box, velocity, 1.0))
        fusion.update(observation, movers, level, T, (1.0, 0.0))
    return {obj.id: obj for obj in fusion.objects(poses)}


def errors(obj, mover, T_world):
    """Distances (n,) of the mesh to the true surface after one alignment, and errors (m,) of the positions, metres.

    ``T_world`` maps the trajectory's world to that of the truth.
    """
    estimates = T_world @ obj.trajectory.Ts_world_camera
    truths = np.array([mover.reference(t) for t in obj.trajectory.timestamps])
    X = se3.inverse(estimates[len(truths) // 2]) @ truths[len(truths) // 2]  # true object to ours
    points = obj.mesh.vertices.astype(np.float64)

    def distances(x, points):
        T = se3.inverse(X @ se3.exp(x))
        there = points @ T[:3, :3].T + T[:3, 3]
        return np.min([primitive.distance(there) for primitive in mover.primitives], axis=0)

    fit = least_squares(distances, np.zeros(6), args=(points[:: len(points) // 1000],), loss="soft_l1", f_scale=0.005)
    offset = np.median(
        [(se3.inverse(e) @ t)[:3, 3] for e, t in zip(estimates, truths, strict=True)], axis=0
    )  # of the two origins, in our object frame
    places = estimates[:, :3, :3] @ offset + estimates[:, :3, 3]
    return np.abs(distances(fit.x, points)), np.linalg.norm(places - truths[:, :3, 3], axis=1)


def test_the_window_stays_around_the_object_and_is_small():
    volume = ObjectVolume(SMALL, VolumeConfig(voxel_size=0.005), SensorConfig(), 6.0)
    T = np.eye(4)
    T[:3, 3] = 0, 0, -3
    volume.look_at(T)
    half = volume.window.shape * volume.block_size / 2
    origin = volume.window.T_grid_camera(np.eye(4))[:, 3] * volume.voxel_size
    np.testing.assert_allclose(origin, half, atol=2 * volume.block_size)
    assert (half > 1.0).all()
    assert volume.window.cells.nbytes < 4e6
    assert volume.depth_max == 6.0
    assert not volume.config.carving


def test_a_cleared_map_is_empty_and_can_be_filled_again():
    sequence = dudmap.lab.synthetic.sequence("box", [], frames=1, camera=SMALL, camera_path="still", noise="none")
    volume = ObjectVolume(SMALL, VolumeConfig(voxel_size=0.02), SensorConfig(), 6.0)
    T = np.eye(4)
    T[2, 3] = -float(np.median(sequence[0].depth))  # the object's origin lies on the surface in the image
    counts = []
    for _ in range(2):
        assert volume.is_empty
        volume.look_at(T)
        volume.integrate(sequence[0], T)
        counts.append(volume.num_blocks)
        volume.clear()
    assert counts[0] == counts[1] > 0
    assert volume.is_empty
    assert volume.window.shape.tolist() == ObjectVolume(SMALL, volume.config, SensorConfig(), 6.0).window.shape.tolist()
    assert not volume.config.carving


def test_a_cart_is_rigid_and_gets_its_shape():
    sequence = dudmap.lab.synthetic.sequence(
        "box", ["creeper"], frames=30, speed=0.5, start_dynamic=True, camera=SMALL, camera_path="still", seed=1
    )
    (obj,) = fused(sequence, range(4, 30)).values()
    assert obj.rigid, obj.reason
    assert obj.trajectory is not None
    assert len(obj.trajectory) == obj.frames >= 20
    shape, path = errors(obj, sequence._movers[0], np.eye(4))
    assert np.median(shape) < 0.003
    assert np.percentile(shape, 90) < 0.01
    assert np.sqrt(np.mean(path**2)) < 0.01
    # the origin is the middle of the mesh
    np.testing.assert_allclose(obj.mesh.vertices.min(axis=0), -obj.mesh.vertices.max(axis=0), atol=1e-5)


def test_a_walking_person_is_rejected_with_a_reason():
    sequence = dudmap.lab.synthetic.sequence(
        "box", ["person"], frames=36, speed=0.8, start_dynamic=True, camera=SMALL, camera_path="still", seed=1
    )
    (obj,) = fused(sequence, range(36)).values()
    assert not obj.rigid
    assert obj.mesh is None
    assert obj.trajectory is None
    assert obj.reason.startswith("not rigid")


def test_an_object_at_rest_is_not_moving():
    sequence = dudmap.lab.synthetic.sequence(
        "box", ["stopping_cart"], frames=90, start_dynamic=True, camera=SMALL, camera_path="still", seed=1
    )
    (obj,) = fused(sequence, range(70, 90)).values()
    assert not obj.rigid
    assert obj.reason.startswith("moved by 0.")


def test_a_few_frames_do_not_prove_an_object_rigid():
    sequence = dudmap.lab.synthetic.sequence(
        "box", ["creeper"], frames=8, speed=0.5, start_dynamic=True, camera=SMALL, camera_path="still", seed=1
    )
    (obj,) = fused(sequence, range(4, 8)).values()
    assert not obj.rigid
    assert obj.reason.startswith("seen too short: 4 frames")


def test_off_by_default_and_without_influence():
    sequence = dudmap.lab.synthetic.sequence("box", ["person"], frames=12, start_dynamic=True, camera=SMALL)
    off, on = Slam(sequence.camera), Slam(sequence.camera, ON)
    for i in range(12):
        a, b = off.process(sequence[i]), on.process(sequence[i])
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        np.testing.assert_array_equal(a.dynamic_mask, b.dynamic_mask)
        assert "bodies" not in a.timings
    assert off.objects.fusion is None
    assert off.rigid_objects == []
    assert len(on.rigid_objects) > 0
    assert off.volume.num_blocks == on.volume.num_blocks


@pytest.mark.slow
def test_run_writes_meshes_of_rigid_movers(tmp_path):
    """The whole system on a moving camera: a ball rolls, a cart creeps, each in its own recording."""
    for name, rms, seed in (("creeper", 0.01, 0), ("ball", 0.02, 0)):
        sequence = dudmap.lab.synthetic.sequence("room", [name], frames=100, seed=seed)
        out = tmp_path / name
        (out / "movers").mkdir(parents=True)
        (out / "movers" / "77.ply").write_text("of an earlier run")
        report = run(sequence, ON, out, progress=False, save_map=False)
        objects = json.loads((out / "metrics.json").read_text())["bodies"]
        assert objects == report.metrics["bodies"]
        rigid = [obj for obj in objects if obj["rigid"]]
        assert len(rigid) == 1
        assert all(obj["why_not"] for obj in objects if not obj["rigid"])
        number = rigid[0]["id"]
        assert sorted(path.name for path in (out / "movers").iterdir()) == [f"{number}.ply", f"{number}.txt"]
        mesh, path = Mesh.load(out / "movers" / f"{number}.ply"), Trajectory.load(out / "movers" / f"{number}.txt")
        obj = RigidObject(number, True, "", rigid[0]["frames"], mesh, path)
        shape, way = errors(obj, sequence._movers[0], sequence.ground_truth.Ts_world_camera[0])
        assert np.median(shape) < 0.004
        assert np.percentile(shape, 90) < 0.02
        assert np.sqrt(np.mean(way**2)) < rms
