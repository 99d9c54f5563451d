"""Recordings that are single files, out of archives; and files that are not read."""

import zipfile

import numpy as np
import pytest

from bags import write_bag
from dudmap.io.sequences import is_recording, open_sequence
from recordings import HEIGHT, WIDTH
from sequences.test_klg import NUMBERS, write_klg
from sequences.test_record3d import write_r3d
from sequences.test_sens import write_sens


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))


def zipped(path):
    """Archive of a file or folder, which is removed."""
    out = path.parent / "packed.zip"
    with zipfile.ZipFile(out, "w") as archive:
        for file in [path] if path.is_file() else sorted(path.iterdir()):
            archive.write(file, f"inside/{file.relative_to(path.parent)}")
    return out


WRITERS = {
    "sens": lambda folder: write_sens(folder / "a.sens"),
    "klg": lambda folder: write_klg(folder / "a.klg"),
    "r3d": lambda folder: write_r3d(folder / "a.r3d"),
    "ros1": lambda folder: write_bag(folder / "a.bag", "ros1"),
    "sqlite": lambda folder: write_bag(folder / "a", "sqlite"),
    "mcap": lambda folder: write_bag(folder / "a", "mcap"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_is_read_from_its_archive(tmp_path, kind):
    path = WRITERS[kind](tmp_path)
    camera = NUMBERS if kind == "klg" else None
    expected, packed = open_sequence(path, camera), open_sequence(zipped(path), camera)
    assert packed.format == expected.format
    np.testing.assert_array_equal(packed.timestamps, expected.timestamps)
    np.testing.assert_array_equal(packed[1].depth, expected[1].depth)
    np.testing.assert_array_equal(packed[1].color, expected[1].color)


def test_a_folder_with_one_file_is_that_recording(tmp_path):
    (tmp_path / "walk").mkdir()
    write_sens(tmp_path / "walk" / "a.sens")
    assert open_sequence(tmp_path / "walk").camera.shape == (HEIGHT, WIDTH)
    assert is_recording(tmp_path / "walk" / "a.sens")
