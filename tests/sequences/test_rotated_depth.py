"""Depth images of rotated millimetres (SUN3D) are recognised by their values; others are not taken for them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from dudmap.app.pipeline.inspection import inspect
from dudmap.io.sequences import open_sequence
from dudmap.io.sequences.rotated_depth import Rotated, judge
from layout_images import write_color

EXCERPT = Path(__file__).parents[1] / "fixtures" / "freiburg1_xyz"
CAMERA = "60,61,31,23"


def kinect(median, width=64, height=48, frames=3, seed=0):
    """Millimetres of a sloping, noisy scene as the disparities of a Kinect have them (Khoshelham and Elberink 2012)."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0.5, 1.7, width), np.linspace(0.9, 1.1, height))
    for _ in range(frames):
        z = median * x * y * rng.normal(1, 0.002, x.shape)
        disparity = np.round(8 * 580 * 75 / (1000 * z)) / 8  # eighths of a pixel; 580 pixels, 75 mm
        depth = 580 * 75 / disparity
        depth[:5, :7] = 0
        yield np.round(depth).astype(np.uint16)


def rotated(millimetres):
    wide = millimetres.astype(int)
    return ((wide << 3 | wide >> 13) & 0xFFFF).astype(np.uint16)


def judged(images, scale):
    return judge(len(images), lambda n: images[n].astype(np.float32), scale, given=False)


def write(folder, images, place="depth"):
    for k, depth in enumerate(images):
        write_color(folder / f"image/{k}.png", k, depth.shape[1], depth.shape[0])
        (folder / place).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"{place}/{k}.png"), depth)
    return folder


@pytest.mark.parametrize("median", [0.8, 1.5, 3.0, 5.0])
def test_rotated_millimetres_are_read(median, tmp_path):
    truth = list(kinect(median))
    folder = write(tmp_path, map(rotated, truth))
    sequence = open_sequence(folder, CAMERA)
    for k, depth in enumerate(truth):
        np.testing.assert_allclose(sequence[k].depth, depth / 1000, atol=1e-6)  # also beyond 8.19 m
    assert sequence.camera.depth_scale == 8000
    assert "rotated left by three bits, as in SUN3D" in sequence.sources["depth unit"]
    said = inspect(sequence).warnings
    assert sum("read as 0.125 mm per unit; --depth-unit METRES says otherwise" in text for text in said) == 1
    assert not any("the depth scale looks wrong" in text for text in said)


def test_a_given_unit_forbids_it_and_its_own_unit_keeps_it(tmp_path):
    truth = list(kinect(5.0))
    folder = write(tmp_path, map(rotated, truth))
    plain = open_sequence(folder, CAMERA, depth_unit=0.001)
    np.testing.assert_allclose(plain[0].depth, rotated(truth[0]) / 1000, rtol=1e-6)
    assert not any("multiples of 8" in text for text in inspect(plain).warnings)
    kept = open_sequence(folder, CAMERA, depth_unit=0.000125)
    np.testing.assert_allclose(kept[0].depth, truth[0] / 1000, atol=1e-6)
    assert kept.sources["depth unit"] == "--depth-unit 0.000125"


def test_a_unit_in_a_file_is_kept_but_doubted(tmp_path):
    folder = write(tmp_path, map(rotated, kinect(2.0)))
    (folder / "intrinsics.txt").write_text("fx 60\nfy 61\ncx 31\ncy 23\ndepth_scale 1000\n")
    sequence = open_sequence(folder)
    assert sequence.camera.depth_scale == 1000
    said = inspect(sequence).warnings
    assert any("if distances come out eight times too large, give --depth-unit 0.000125" in text for text in said)
    assert not any("would be plausible" in text for text in said)


def test_lists_of_images_have_them_too(tmp_path):
    truth = list(kinect(2.0))
    folder = write(tmp_path, map(rotated, truth))
    (folder / "associations.txt").write_text("".join(f"{k} image/{k}.png {k} depth/{k}.png\n" for k in range(3)))
    sequence = open_sequence(folder, CAMERA)
    assert sequence.format == "TUM RGB-D"
    np.testing.assert_allclose(sequence[1].depth, truth[1] / 1000, atol=1e-6)


def uniform(step, low, high):
    """Values in equal steps that all occur."""
    rng = np.random.default_rng(1)
    return [(rng.integers(low // step, high // step, (240, 320)) * step).astype(np.uint16) for _ in range(3)]


OTHERS = {
    "millimetres": (list(kinect(2.0)), 1000.0),
    "TUM's unit": ([5 * depth for depth in kinect(2.0)], 5000.0),
    "steps of 8 mm at 5000 a metre": ([depth // 8 * 40 for depth in kinect(2.0)], 5000.0),
    "8-bit depth times 8": ([(depth // 16).astype(np.uint16) * 8 for depth in kinect(2.0)], 1000.0),
    "8-bit depth times 256": ([(depth // 16).astype(np.uint16) * 256 for depth in kinect(2.0)], 1000.0),
    "tenths of a millimetre": ([10 * depth for depth in kinect(2.0)], 10000.0),
    "an even unit": ([16 * (depth // 2) for depth in kinect(2.0)], 5000.0),
    "eighths of a millimetre with noise": ([8 * d + np.arange(64, dtype=np.uint16) % 8 for d in kinect(2.0)], 8000.0),
    "the players of a Kinect's driver": (
        [8 * depth + np.uint16(1) * (np.arange(64) > 40) for depth in kinect(2.0)], 1000.0,
    ),
    "one plane": ([np.full((240, 320), 4000, np.uint16)] * 3, 1000.0),
}  # fmt: skip


@pytest.mark.parametrize(("images", "scale"), OTHERS.values(), ids=OTHERS)
def test_other_values_are_not_taken_for_rotated(images, scale):
    assert judged(images, scale) is Rotated.NO


@pytest.mark.parametrize("scale", [1000.0, 5000.0])
def test_equal_steps_of_8_that_are_plausible_as_they_are_stay(scale):
    """A sensor with steps of 8 mm, and rotated images of a near scene, have the same values."""
    images = uniform(8, 1000, 8000)
    assert judged(images, scale) is Rotated.POSSIBLY


def test_real_recordings_are_not_rotated():
    sequence = open_sequence(EXCERPT)
    assert sequence.rotated is Rotated.NO
    assert sequence.remarks == []
