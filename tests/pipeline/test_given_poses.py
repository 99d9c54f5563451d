"""Poses that are given: fused as they are, or the start of registration; read in any format, refused in a wrong one."""

import json
from itertools import product

import numpy as np
import pytest

from dudmap import Camera, Config, ConfigError, DatasetError, FrameError, Slam
from dudmap.app.pipeline.given_poses import GivenPoses, given_poses
from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.pose_conventions import AXES, USED, Convention, check_convention
from dudmap.app.pipeline.resume import resume
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.storing import Storing
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.evaluation.trajectory import ate
from dudmap.lab.synthetic import sequence
from rendered import Rendered

CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
COARSE = Config().override(["volume.voxel_size=0.04", "sensor.self_calibration=false"])


@pytest.fixture(scope="module")
def room():
    return Rendered(sequence("room", ("person",), frames=40, seed=3, camera=CAMERA))


def drifting(Ts, seed=0):
    """Poses with noise of 1 cm and 0.5 degrees and a drift of 6 cm and 2 degrees over them."""
    random, steps = np.random.default_rng(seed), np.linspace(0, 1, len(Ts))[:, None]
    drift = se3.exp_all(steps * np.array([0.05, 0.03, 0, 0, 0, np.radians(2)]))
    spread = np.repeat([0.01 / np.sqrt(3), np.radians(0.5) / np.sqrt(3)], 3)
    return drift @ Ts @ se3.exp_all(random.normal(size=(len(Ts), 6)) * spread)


def processed(recording, Ts, **given):
    slam = Slam(recording.camera, COARSE, **given)
    results = []
    for index, T in enumerate(Ts):
        known = {} if T is None else {"T_world_camera": T}
        results.append(slam.process(recording[index], **known))
    return slam, results


@pytest.fixture(scope="module")
def estimated(room):
    """Results without given poses."""
    return processed(room, [None] * len(room))[1]


def iou(recording, results):
    """Mean intersection over union of the masks of frames with people."""
    pairs = [(recording.mask(index), result.dynamic_mask) for index, result in enumerate(results)]
    return np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs if a.mean() > 0.02])


def error(Ts, results):
    """Absolute trajectory error (rmse), metres."""
    found = Trajectory(np.arange(len(Ts)), np.array([result.T_world_camera for result in results]))
    return np.sqrt(np.mean(ate(found, Trajectory(np.arange(len(Ts)), Ts)).trans_errors ** 2))


def test_given_poses_are_the_result_and_people_are_left_out(room, estimated):
    Ts = room.ground_truth.Ts_world_camera
    slam, results = processed(room, Ts, poses="given")
    np.testing.assert_allclose([result.T_world_camera for result in results], Ts, atol=1e-12)
    np.testing.assert_allclose(slam.trajectory.Ts_world_camera, Ts, atol=1e-12)
    assert iou(room, results) > iou(room, estimated) - 0.02
    assert np.mean([result.fused for result in results]) > 0.5


def test_drifting_poses_are_the_start_of_registration(room, estimated):
    Ts = room.ground_truth.Ts_world_camera
    start = drifting(Ts)
    _, refined = processed(room, start, poses="refined")
    assert all(result.status == "tracked" for result in refined)
    assert error(Ts, refined) < 1.5 * error(Ts, estimated)
    _, kept = processed(room, start, poses="given")
    assert error(Ts, refined) < 0.5 * error(Ts, kept)


def test_given_motion_carries_a_lost_frame_over_a_gap(room):
    """After frames without an image the motion of the given poses leads to the place; constant velocity does not."""
    Ts = room.ground_truth.Ts_world_camera
    order = [*range(8), 39]
    results = {}
    for role in ("estimated", "refined"):
        slam = Slam(CAMERA, COARSE.override(["relocalization.enabled=false"]), poses=role)
        for index in order:
            T = None if role == "estimated" else Ts[index] @ se3.exp(np.array([0.01, 0, 0, 0, 0.01, 0]))
            results[role] = slam.process(room[index], T_world_camera=T)
    assert results["refined"].status == "tracked"
    start = se3.inverse(Ts[0] @ se3.exp(np.array([0.01, 0, 0, 0, 0.01, 0])))
    found = start @ results["refined"].T_world_camera
    assert np.linalg.norm(found[:3, 3] - (se3.inverse(Ts[0]) @ Ts[39])[:3, 3]) < 0.05


def test_frames_without_a_given_pose_are_left_out_and_wrong_ones_refused(room):
    Ts = room.ground_truth.Ts_world_camera
    _, results = processed(room, [Ts[0], None, Ts[2]], poses="given")
    assert [result.status for result in results] == ["tracked", "rejected", "tracked"]
    assert "pose" in results[1].verdict
    with pytest.raises(ConfigError, match="a pose is given for a frame"):
        Slam(CAMERA, COARSE).process(room[0], T_world_camera=Ts[0])
    for wrong in (np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4)):
        with pytest.raises(FrameError, match="the given pose"):
            Slam(CAMERA, COARSE, poses="given").process(room[0], T_world_camera=wrong)


def written(convention, Ts):
    """The numbers of a file in a convention that give these poses."""
    Ts = Ts @ np.linalg.inv(AXES[convention.axes]) if convention.axes else Ts.copy()
    Ts = se3.inverse(Ts) if convention.inverse else Ts
    if convention.millimetres:
        Ts[:, :3, 3] *= 1000
    if convention.wxyz:
        quats = [np.roll(se3.rotation_to_quat_xyzw(R), 1) for R in Ts[:, :3, :3]]
        Ts[:, :3, :3] = [se3.quat_xyzw_to_rotation(quat) for quat in quats]
    return Ts


WAYS = [Convention(*way) for way in product((False, True), ("", *AXES), (False, True), (False, True))]


@pytest.mark.parametrize("convention", WAYS, ids=str)
def test_a_wrong_convention_is_named(room, convention):
    stamps, Ts = room.timestamps, room.ground_truth.Ts_world_camera
    for poses in (Ts, drifting(Ts)):
        np.testing.assert_allclose(convention.poses(written(convention, poses)), poses, atol=1e-9)
        if convention == USED:
            check_convention(Trajectory(stamps, poses), room, "poses.txt", USED)
            continue
        with pytest.raises(DatasetError, match=f"contradict the images.*give --poses-as {convention}$"):
            check_convention(Trajectory(stamps, written(convention, poses)), room, "poses.txt", USED)


def test_every_format_gives_the_same_poses(room, tmp_path):
    Ts = room.ground_truth.Ts_world_camera
    rows = [" ".join(f"{number:.12f}" for number in T.reshape(-1)) for T in Ts]
    (tmp_path / "kitti.txt").write_text("\n".join(" ".join(row.split()[:12]) for row in rows))
    (tmp_path / "lines.txt").write_text("\n".join(rows))
    stacked = ["\n".join(" ".join(row.split()[4 * i : 4 * i + 4]) for i in range(4)) for row in rows]
    (tmp_path / "stacked.log").write_text("\n".join(f"{i} {i} {i + 1}\n{text}" for i, text in enumerate(stacked)))
    (tmp_path / "each").mkdir()
    for number, text in enumerate(stacked):
        (tmp_path / "each" / f"frame-{number}.pose.txt").write_text(text)
    room.ground_truth.save(tmp_path / "tum.txt")
    for name in ("kitti.txt", "lines.txt", "stacked.log", "each", "tum.txt", "recording"):
        found = given_poses(name if name == "recording" else str(tmp_path / name), room)
        np.testing.assert_allclose(found.trajectory.Ts_world_camera, Ts, atol=1e-6, err_msg=name)
    inverse = Trajectory(room.timestamps, se3.inverse(Ts) @ AXES["opengl"])
    inverse.save(tmp_path / "other.txt")
    shorter = "\n".join(" ".join(row.split()[:12]) for row in rows[:-1])
    (tmp_path / "short.txt").write_text(shorter)
    for name, said in (("none.txt", "there is no file"), ("short.txt", "holds 39 poses without times.*40 frames")):
        with pytest.raises(DatasetError, match=said):
            given_poses(str(tmp_path / name), room)
    Trajectory(room.timestamps + 1000, Ts).save(tmp_path / "later.txt")
    with pytest.raises(DatasetError, match=r"none of the 40 poses .* is within 50 ms of a frame"):
        given_poses(str(tmp_path / "later.txt"), room)
    with pytest.raises(ConfigError, match="expected tum, euroc or kitti"):
        given_poses("recording", room, "upside-down")


def test_poses_are_interpolated_between_near_ones_only(room):
    Ts, stamps = room.ground_truth.Ts_world_camera, room.timestamps
    poses = GivenPoses(Trajectory(stamps[[0, 1, 2, 9]], Ts[[0, 1, 2, 9]]), "given")
    middle = (stamps[0] + stamps[1]) / 2
    np.testing.assert_allclose(poses.at(middle), room.ground_truth.interpolate(middle))
    assert poses.at(stamps[5]) is None
    assert poses.at(stamps[0] - 0.01) is None


@pytest.mark.parametrize("passes", [1, 2])
def test_a_run_with_given_poses(room, tmp_path, passes):
    poses = given_poses("recording", room)
    report = run(room, COARSE, tmp_path / "run", poses=poses, passes=passes, max_frames=8, progress=False)
    truth = room.ground_truth.Ts_world_camera[:8]
    np.testing.assert_allclose(report.trajectory.Ts_world_camera, truth, atol=1e-6)
    assert report.metrics["poses"] == {"role": "given", "given": 40, "correction": None}
    refined = GivenPoses(Trajectory(room.timestamps, drifting(room.ground_truth.Ts_world_camera)), "refined")
    report = run(room, COARSE, tmp_path / "run", poses=refined, max_frames=8, progress=False)
    correction = json.loads((tmp_path / "run" / "metrics.json").read_text())["poses"]["correction"]
    motions = se3.inverse(refined.trajectory.Ts_world_camera[:8]) @ report.trajectory.Ts_world_camera
    assert correction["max_mm"] == pytest.approx(1000 * np.linalg.norm(motions[:, :3, 3], axis=1).max(), abs=0.01)


class Interrupted(RunObserver):
    def frame(self, index, read, result, ms):
        if index == 5:
            raise KeyboardInterrupt


def test_a_resumed_run_uses_the_same_poses(room, tmp_path):
    start = GivenPoses(Trajectory(room.timestamps, drifting(room.ground_truth.Ts_world_camera)), "refined")
    whole = run(room, COARSE, tmp_path / "whole", poses=start, max_frames=9, progress=False)
    storing = Storing({}, every=0)
    with pytest.raises(KeyboardInterrupt):
        run(
            room, COARSE, tmp_path / "run", poses=start, max_frames=9, progress=False, storing=storing,
            observers=(Interrupted(),),
        )  # fmt: skip
    resumed = resume(tmp_path / "run", room, progress=False)
    np.testing.assert_array_equal(resumed.trajectory.Ts_world_camera, whole.trajectory.Ts_world_camera)
    assert resumed.metrics["poses"] == whole.metrics["poses"]
