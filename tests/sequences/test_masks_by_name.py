"""Masks from outside belong to the image whose name, number or time they have; the others are counted and named."""

import json

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.frame_source import open_masks
from dudmap.core.geometry.camera import Camera
from dudmap.errors import DatasetError
from dudmap.evaluation.segmentation import mask_pairs
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.masks import MaskFolder
from layout_images import write_color, write_depth
from layouts import tum, write

FRAMES = (0, 1, 2, 30, 31)
SHAPE = (48, 64)


def width(number):
    """Width of the mask of an image: every image has another one."""
    return 3 + number


def write_mask(path, number):
    mask = np.zeros(SHAPE, np.uint8)
    mask[:, : width(number)] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)


def found(masks, count):
    """Widths of the masks of all frames, None without one."""
    read = (masks[index] for index in range(count))
    return [None if mask is None else int(mask.sum() // SHAPE[0]) for mask in read]


@pytest.fixture
def numbered(tmp_path):
    """A recording of numbered images, of which the frames count 0, 1, 2, 3, 4."""
    folder = tmp_path / "numbered"
    for number in FRAMES:
        write_color(folder / f"color/{number:06d}.png", number)
        write_depth(folder / f"depth/{number:06d}.png", number)
    (folder / "intrinsics.txt").write_text("60 61 31 23\n")
    return folder


NAMES = ("{:06d}.png", "{}.png", "rgb_{:06d}.png", "frame-{:06d}.mask.png", "mask_{}.png", "{:04d}_mask_person.png",
         "color_{:06d}_0.png")  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_names_pair_with_names(numbered, tmp_path, name):
    for number in FRAMES:
        write_mask(tmp_path / "masks" / name.format(number), number)
    if name == NAMES[-1]:
        with pytest.raises(DatasetError, match=r"both .* and .* are masks of frame 0|belongs to a frame"):
            open_masks(tmp_path / "masks", open_sequence(numbered))
        return
    masks = open_masks(tmp_path / "masks", open_sequence(numbered))
    assert found(masks, 5) == [width(number) for number in FRAMES]
    assert masks.complete
    assert masks.said == "masks: 5 of 5 frames have one (5 by name)"


def test_other_images_of_the_folder_are_no_masks(numbered, tmp_path):
    for number in FRAMES:
        write_mask(tmp_path / "masks" / f"{number:06d}_mask.png", number)
        write_color(tmp_path / "masks" / f"{number:06d}.png", number)
    write_mask(tmp_path / "masks" / "overview_2.png", 9)
    masks = open_masks(tmp_path / "masks", open_sequence(numbered))
    assert found(masks, 5) == [width(number) for number in FRAMES]


def test_frames_without_a_mask_and_masks_without_a_frame_are_counted(numbered, tmp_path):
    for number in (1, 30, 77):
        write_mask(tmp_path / "masks" / f"{number}.png", number)
    masks = open_masks(tmp_path / "masks", open_sequence(numbered))
    assert found(masks, 5) == [None, width(1), None, width(30), None]
    assert not masks.complete
    assert masks.said == "masks: 2 of 5 frames have one (2 by name); 1 of 3 masks belong to no frame"


def test_numbers_of_no_image_are_no_seconds(numbered, tmp_path):
    for number in range(100, 105):
        write_mask(tmp_path / "masks" / f"{number}.png", 1)
    with pytest.raises(
        DatasetError, match=r"none of the 5 masks .* named such as 100\.png, and no image .* such a num"
    ):
        open_masks(tmp_path / "masks", open_sequence(numbered))


def test_times_of_masks_of_numbered_images_are_still_times(numbered, tmp_path):
    sequence = open_sequence(numbered)
    for index, stamp in enumerate(sequence.timestamps):
        write_mask(
            tmp_path / "masks" / f"{stamp:.6f}.png", index
        )  # 1.000000 is frame 30, as the folder of a run has it
    masks = open_masks(tmp_path / "masks", sequence)
    assert found(masks, 5) == [width(index) for index in range(5)]
    assert "(5 by time)" in masks.said


@pytest.mark.parametrize("per_second", [1e3, 1e6, 1e9])
def test_times_in_other_units(tmp_path, per_second):
    times = 1_700_000_000 + np.arange(4) / 10
    for index, stamp in enumerate(times):
        write_mask(tmp_path / f"{round((stamp + 0.004) * per_second)}.png", index)
    masks = MaskFolder(tmp_path, times, Camera(60, 60, 31.5, 23.5, 64, 48))
    assert found(masks, 4) == [width(index) for index in range(4)]


def test_names_of_colour_images_come_before_times(tmp_path):
    folder, _ = write(tum, tmp_path)
    lines = [f"{100.04 + 0.1 * k:.6f} depth/{100 + 0.1 * k:.6f}.png" for k in range(3)]
    (folder / "depth.txt").write_text("\n".join(lines))
    (folder / "rgb.txt").write_text("\n".join(f"{100.03 + 0.1 * k:.6f} rgb/{100 + 0.1 * k:.6f}.png" for k in range(3)))
    for k in range(3):
        write_mask(tmp_path / "masks" / f"{100 + 0.1 * k:.6f}.png", k)
    assert found(open_masks(tmp_path / "masks", open_sequence(folder)), 3) == [width(k) for k in range(3)]


def test_numbers_for_a_recording_without_names_are_refused(tmp_path):
    for number in range(5):
        write_mask(tmp_path / f"{number:06d}.png", number)
    with pytest.raises(DatasetError, match=r"has no numbered images; expected .*<timestamp>\.png in seconds"):
        MaskFolder(tmp_path, np.arange(150) / 30, Camera(60, 60, 31.5, 23.5, 64, 48))


def test_two_masks_of_one_frame_are_refused(numbered, tmp_path):
    for name in ("30.png", "000030.png"):
        write_mask(tmp_path / "masks" / name, 30)
    with pytest.raises(DatasetError, match=r"both 000030\.png and 30\.png in .* are masks of frame 3"):
        open_masks(tmp_path / "masks", open_sequence(numbered))


def test_masks_of_a_run_against_masks_named_like_the_images(numbered, tmp_path):
    sequence = open_sequence(numbered)
    run = tmp_path / "run"
    for index, stamp in enumerate(sequence.timestamps):
        write_mask(run / "masks" / f"{stamp:.6f}.png", FRAMES[index])
    for number in FRAMES:
        write_mask(tmp_path / "true" / f"{number:06d}.png", number)
    with pytest.raises(DatasetError, match=r"named by numbers, .* by times, and the recording .* cannot be opened"):
        mask_pairs(run, tmp_path / "true")
    (run / "metrics.json").write_text(json.dumps({"recording": sequence.opened}))
    pairs, missing = mask_pairs(run, tmp_path / "true")
    widths = [(int(pair.estimate.sum()), int(pair.reference.sum())) for pair in pairs]
    assert widths == [(48 * width(number), 48 * width(number)) for number in FRAMES]
    assert missing == 0
