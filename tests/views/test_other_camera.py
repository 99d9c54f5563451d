"""Recordings whose colour camera stands beside the depth camera: cleaned, and exported for view synthesis."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.run_folder import save_mask
from dudmap.app.views.cleaning import clean_recording, grown
from dudmap.config import VolumeConfig
from dudmap.core.geometry import se3
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.lens import Lens, OtherView
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.io.exporting.exporters import export_run
from dudmap.io.exporting.run_content import ExportOptions, RunContent
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.images import read_mask
from dudmap.lab import synthetic
from dudmap.lab.synthetic.faults import SensorFaults
from dudmap.lab.synthetic.folder import write_folder

CAMERA = Camera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, depth_scale=5000.0)
FRAMES = 24


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Run folder and recording with a colour camera 6 cm to the right, which sees a narrower part of the scene."""
    where = tmp_path_factory.mktemp("other")
    faults = SensorFaults(color_translation=(0.06, 0.0, 0.0), color_focal_ratio=1.15)
    sequence = synthetic.sequence(
        scene="room", movers=["person"], camera_path="orbit", frames=FRAMES, fps=6, noise="none", camera=CAMERA,
        faults=faults,
    )  # fmt: skip
    T_depth_color = np.eye(4)
    T_depth_color[0, 3] = 0.06
    calibration = Calibration(sequence.color_camera, se3.inverse(T_depth_color))
    Ts = se3.inverse(sequence.ground_truth.Ts_world_camera[0]) @ sequence.ground_truth.Ts_world_camera
    volume = TsdfVolume(CAMERA, VolumeConfig(voxel_size=0.02))
    (where / "run" / "masks").mkdir(parents=True)
    other = OtherView(Lens(CAMERA), Lens(sequence.color_camera))
    for index in range(FRAMES):
        frame, mask = sequence[index], sequence.mask(index)
        grey = np.full_like(frame.color, 128)  # all colours must come from other frames
        volume.integrate(replace(frame, color=grey), Ts[index], ~mask, count=10)
        save_mask(where / "run" / "masks" / f"{frame.timestamp:.6f}.png", mask)
    volume.save(where / "run" / "map.npz")
    volume.extract_mesh().save(where / "run" / "mesh.ply")
    Trajectory(sequence.timestamps, Ts).save(where / "run" / "trajectory.txt")
    calibration.save(where / "run" / "calibration.toml")
    write_folder(sequence, where / "recording", surface=False)
    camera = sequence.color_camera
    lines = [f"{key} {getattr(CAMERA, key)}" for key in ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")]
    lines += [f"color_{key} {getattr(camera, key)}" for key in ("fx", "fy", "cx", "cy", "width", "height")]
    lines += ["T_depth_color " + " ".join(str(x) for x in T_depth_color.reshape(-1))]
    (where / "recording" / "intrinsics.txt").write_text("\n".join(lines) + "\n")
    return where, sequence, other, calibration


def hidden_by_person(sequence, index):
    """Pixels of the colour image that the person covers: where it differs from the static twin's."""
    difference = np.abs(sequence[index].color.astype(int) - sequence.static_twin()[index].color).max(axis=2)
    return difference > 20


def test_masks_are_seen_from_the_other_camera(made):
    _, sequence, other, calibration = made
    shares = []
    for index in range(6, FRAMES, 6):
        mask = sequence.mask(index)
        found = other.mask(mask, sequence[index].depth, calibration.T_color_depth)
        true = hidden_by_person(sequence, index)
        if true.sum() > 200:
            shares.append([grown(found, 2)[true].mean(), grown(true, 4)[found].mean()])
    assert len(shares) >= 2
    assert np.min(shares) > 0.93


def test_depth_is_seen_from_the_other_camera(made):
    """A plane at 2 m stays at 2 m, and lies where the projection of its points does."""
    _, _, other, calibration = made
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    found = other.depth(depth, calibration.T_color_depth)
    assert np.mean(found > 0) > 0.9
    np.testing.assert_allclose(found[found > 0], 2.0)
    depth[:, 80:] = 0
    shown = np.nonzero((other.depth(depth, calibration.T_color_depth) > 0).any(axis=0))[0].max()
    point = np.array([[(79 - CAMERA.cx) / CAMERA.fx * 2 - 0.06, 0, 2.0]])
    assert abs(shown - calibration.camera.project(point)[0, 0]) <= 1.5


def test_what_another_surface_hides_from_the_other_camera_is_not_in_its_mask():
    """A camera 30 cm to the left sees a post at 1 m before most of a marked part of the wall at 3 m."""
    depth, mask = np.full(CAMERA.shape, 3.0, np.float32), np.zeros(CAMERA.shape, bool)
    depth[:, 70:90] = 1.0
    mask[40:80, 92:110] = True
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.3
    found = OtherView(Lens(CAMERA), Lens(CAMERA)).mask(mask, depth, T_color_depth)
    wall, post = (round(CAMERA.fx * 0.3 / z) for z in (3.0, 1.0))
    expected = np.zeros(CAMERA.shape, bool)
    expected[40:80, 92 + wall : 70 + post] = True
    assert np.count_nonzero(expected) == 40 * 4
    assert not np.any(found & ~grown(expected, 1))
    assert np.all(found[expected])


def test_both_cameras_are_cleaned(made):
    where, sequence, _, calibration = made
    out = where / "cleaned"
    report = clean_recording(RunContent.load(where / "run"), open_sequence(where / "recording"), out)
    assert report.frames == FRAMES
    result, twin = open_sequence(out), sequence.static_twin()
    assert result.calibration is not None
    np.testing.assert_allclose(result.calibration.T_color_depth, calibration.T_color_depth, atol=1e-6)
    assert result.calibration.camera.fx == pytest.approx(calibration.camera.fx)
    before, after, seen = [], [], 0
    for index in range(FRAMES):
        frame, truth = result[index], twin[index]
        person = hidden_by_person(sequence, index)
        stamp = f"{frame.timestamp:.6f}.png"
        known = person & ~read_mask(out / "unknown_color" / stamp)
        seen += known.sum() / max(person.sum(), 1) / FRAMES
        before.append(((sequence[index].color.astype(float) - truth.color)[known] ** 2).reshape(-1))
        after.append(((frame.color.astype(float) - truth.color)[known] ** 2).reshape(-1))
        replaced = read_mask(out / "replaced" / stamp)
        assert replaced[sequence.mask(index)].all()
        both = replaced & (frame.depth > 0) & (truth.depth > 0)
        if both.any():
            assert np.median(np.abs(frame.depth - truth.depth)[both]) < 0.02
    psnr = [10 * np.log10(255**2 / np.concatenate(part).mean()) for part in (before, after)]
    assert psnr[1] > psnr[0] + 8
    assert psnr[1] > 19  # 160x120 pixels


def test_the_other_camera_is_exported_for_view_synthesis(made, tmp_path):
    where, sequence, _, calibration = made
    options = ExportOptions(sequence=where / "recording", every=6)
    tree = json.loads(export_run(where / "run", tmp_path / "transforms.json", options).read_text())
    camera = calibration.camera
    assert (tree["fl_x"], tree["cx"], tree["w"]) == (camera.fx, camera.cx + 0.5, camera.width)
    Ts = RunContent.load(where / "run").trajectory.Ts_world_camera
    first = np.array(tree["frames"][1]["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
    np.testing.assert_allclose(first, Ts[6] @ se3.inverse(calibration.T_color_depth), atol=1e-9)
    depth = cv2.imread(str(tmp_path / tree["frames"][1]["depth_file_path"]), cv2.IMREAD_UNCHANGED) / 1000
    assert np.mean(depth > 0) > 0.8
    mask = cv2.imread(str(tmp_path / tree["frames"][1]["mask_path"]), cv2.IMREAD_UNCHANGED)
    assert mask.min() == 255  # the person is not yet there
    later = cv2.imread(str(tmp_path / tree["frames"][2]["mask_path"]), cv2.IMREAD_UNCHANGED)
    assert np.mean(later[hidden_by_person(sequence, 12)] == 0) > 0.8
    line = export_run(where / "run", tmp_path / "cameras.txt", options).read_text().splitlines()[1].split()
    assert line[1:5] == ["PINHOLE", "160", "120", f"{camera.fx:.9g}"]
