"""Masks from outside: which frame they belong to, what they do, and what is said of those that do not fit."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dudmap.cli import app
from dudmap.config import Config
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.slam import Slam
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.masks import MaskFolder

EXCERPT = Path(__file__).parents[1] / "fixtures" / "freiburg1_xyz"
CAMERA = Camera(fx=80, fy=80, cx=31.5, cy=23.5, width=64, height=48)


def write(path, shape=(48, 64), where=np.s_[:, :]):
    mask = np.zeros(shape, np.uint8)
    mask[where] = 255
    cv2.imwrite(str(path), mask)


def test_a_mask_belongs_to_the_frame_nearest_in_time(tmp_path):
    write(tmp_path / "10.0150.png", where=np.s_[:, :10])
    write(tmp_path / "10.1.png", where=np.s_[:20])
    (tmp_path / "overview.png").write_bytes(b"not a mask")
    masks = MaskFolder(tmp_path, np.array([10.0, 10.033, 10.066, 10.1]), CAMERA)
    assert masks[1] is None
    assert masks[2] is None
    assert masks[0].sum() == 48 * 10
    assert masks[3].sum() == 20 * 64


def test_folders_that_do_not_fit(tmp_path):
    times = np.array([10.0])
    with pytest.raises(DatasetError, match="there is no folder"):
        MaskFolder(tmp_path / "none", times, CAMERA)
    with pytest.raises(DatasetError, match="holds no masks"):
        MaskFolder(tmp_path, times, CAMERA)
    write(tmp_path / "17.5.png")
    with pytest.raises(DatasetError, match=r"none of the 1 masks .* run from 17.500000 to 17.500000"):
        MaskFolder(tmp_path, times, CAMERA)
    write(tmp_path / "10.0.png", shape=(24, 32))
    with pytest.raises(DatasetError, match="is 32x24 pixels, but the frames are 64x48"):
        MaskFolder(tmp_path, times, CAMERA)[0]
    (tmp_path / "10.0.png").write_bytes(b"")
    with pytest.raises(FrameError):
        MaskFolder(tmp_path, times, CAMERA)[0]


def test_masked_pixels_are_neither_tracked_nor_fused():
    sequence = open_sequence(EXCERPT)
    slam, free = Slam(sequence.camera), Slam(sequence.camera)
    mask = np.zeros(sequence.camera.shape, dtype=bool)
    mask[:, 400:] = True
    for i in range(3):
        frame = sequence[i]
        spoiled = frame.depth.copy()
        spoiled[mask] = np.where(spoiled[mask] > 0, 0.5 + 0.05 * i, 0)  # a board that comes nearer
        result = slam.process(Frame(frame.timestamp, spoiled, frame.color), mask)
        truth = free.process(frame)
        assert result.status == "tracked"
        assert result.dynamic_mask[mask].all()
        assert result.dynamic_share > 0.2
        assert np.linalg.norm(result.T_world_camera[:3, 3] - truth.T_world_camera[:3, 3]) < 0.01
    assert (slam.volume.raycast(np.eye(4)).depth[:, 420:] == 0).mean() > 0.98


@pytest.mark.parametrize("enabled", ["true", "false"])
def test_the_reported_mask_is_the_union(enabled):
    sequence = open_sequence(EXCERPT)
    slam = Slam(sequence.camera, Config().override([f"dynamics.enabled={enabled}"]))
    mask = np.zeros(sequence.camera.shape, dtype=bool)
    mask[100:140, 200:260] = True
    slam.process(sequence[0])
    without = Slam(sequence.camera, slam.config)
    without.process(sequence[0])
    assert (slam.process(sequence[1], mask).dynamic_mask >= mask).all()
    assert not without.process(sequence[1]).dynamic_mask[mask].all()


def test_a_mask_must_fit_the_frame():
    sequence = open_sequence(EXCERPT)
    slam = Slam(sequence.camera)
    with pytest.raises(DatasetError, match="the mask has the shape"):
        slam.process(sequence[0], np.zeros((10, 10), dtype=bool))


def test_run_reads_masks_and_counts_frames_without(tmp_path):
    sequence = open_sequence(EXCERPT)
    folder = tmp_path / "masks"
    folder.mkdir()
    for i in (0, 1, 3):
        write(folder / f"{sequence.timestamps[i] + 0.004:.6f}.png", sequence.camera.shape, np.s_[:100, :100])
    call = ["run", str(EXCERPT), "--out", str(tmp_path / "out"), "--masks", str(folder), "--max-frames", "4"]
    result = CliRunner().invoke(app, [*call, "--json", "--save-masks"])
    assert result.exit_code == 0, result.output
    metrics = json.loads(result.stdout)
    assert (metrics["frames_with_mask"], metrics["frames_without_mask"]) == (3, 1)
    assert f"masks: 3 of {len(sequence)} frames have one (3 by time)" in metrics["warnings"]
    written = sorted((tmp_path / "out" / "masks").iterdir())
    corners = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:100, :100].mean() for path in written]
    assert corners[0] == corners[1] == corners[3] == 255
    assert corners[2] < 128
