"""What is small in a file and large when it is read takes little memory and time, and is refused in a sentence."""

import gzip
import io
import json
import lzma
import os
import tarfile
import time
import tracemalloc
import zlib

import numpy as np
import pytest

from dudmap.app.pipeline.resume import resume
from dudmap.errors import DatasetError, DudmapError
from dudmap.fleet.merge import save_trajectories
from dudmap.input_files import DEEPEST, LARGEST_COUNT, inflated, parse_json, parse_toml
from dudmap.io.sequences import open_sequence


@pytest.fixture
def little():
    """At most 200 MB of memory of Python objects and 10 s."""
    tracemalloc.start()
    start = time.monotonic()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert time.monotonic() - start < 10


def member(kind, size):
    """Header of a tar archive that says that ``size`` bytes follow."""
    info = tarfile.TarInfo("././@PaxHeader")
    info.type, info.size = kind, size
    return info.tobuf(tarfile.USTAR_FORMAT)


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK])
@pytest.mark.parametrize("pack", ["gz", "xz", "none"])
def test_a_header_of_an_archive_that_is_a_bomb(kind, pack, tmp_path, monkeypatch, little):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    size = 300_000_000
    path = tmp_path / f"a.tar{'' if pack == 'none' else f'.{pack}'}"
    opened = {"gz": lambda: gzip.open(path, "wb", 1), "xz": lambda: lzma.open(path, "wb", preset=0),
              "none": lambda: path.open("wb")}  # fmt: skip
    with opened[pack]() as file:
        file.write(member(kind, size))
        for _ in range(20):
            file.write(b"a" * 1_000_000)
    with pytest.raises(DatasetError, match="the headers of a member have more than 1 MB"):
        open_sequence(path)
    assert list((tmp_path / "cache").iterdir()) == []


def test_many_small_headers_before_one_member(tmp_path, monkeypatch, little):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    with gzip.open(tmp_path / "a.tgz", "wb", 1) as file:
        for _ in range(3000):
            file.write(member(tarfile.XGLTYPE, 512) + b"11 a=bcdefg\n".ljust(512, b"\0"))
    with pytest.raises(DatasetError, match="cannot unpack"):
        open_sequence(tmp_path / "a.tgz")


def test_a_dictionary_that_takes_a_gigabyte(tmp_path, monkeypatch, little):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    packer = lzma.LZMACompressor(filters=[{"id": lzma.FILTER_LZMA2, "preset": 0}])
    whole = packer.compress(bytes(10_000)) + packer.flush()
    # the size of the dictionary is one byte of the header of the block, behind which is a checksum of that header
    header = bytearray(whole[12 : 12 + 4 * (whole[12] + 1)])
    assert header[2] == 0x21
    header[4] = 36  # 2^30
    header[-4:] = zlib.crc32(header[:-4]).to_bytes(4, "little")
    (tmp_path / "a.tar.xz").write_bytes(whole[:12] + bytes(header) + whole[12 + len(header) :])
    with pytest.raises(DatasetError, match=r"cannot unpack .*[Mm]emory"):
        open_sequence(tmp_path / "a.tar.xz")


def test_long_names_are_no_bombs(tmp_path, monkeypatch):
    from layouts import tum, write

    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    folder, _ = write(tum, tmp_path / "a")
    for pack in ("", ":gz", ":bz2", ":xz"):
        path = tmp_path / f"desk{pack.replace(':', '.tar.') or '.tar'}"
        with tarfile.open(path, f"w{pack}", format=tarfile.PAX_FORMAT) as file:
            file.add(folder, "desk" * 60)
        assert len(open_sequence(path)) == 3


def test_decompression_is_bounded(little):
    packed = zlib.compress(bytes(2**27), 1)
    with pytest.raises(ValueError, match="unpack to more than 1048576"):
        inflated(packed, 2**20)
    assert inflated(zlib.compress(b"abc"), 10) == b"abc"
    with pytest.raises(ValueError, match="cut off"):
        inflated(zlib.compress(b"abc" * 50)[:-6], 1000)


def test_trees_are_bounded(little):
    for text in ("[" * (DEEPEST + 2) + "]" * (DEEPEST + 2), '{"a":' * 100 + "1" + "}" * 100):
        with pytest.raises(ValueError, match="nested too deeply, by more than 64 levels"):
            parse_json(text)
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml("a = " + "[" * 100 + "]" * 100)
    with pytest.raises(ValueError, match=f"more than {LARGEST_COUNT} values"):
        parse_json("[" + "[]," * (LARGEST_COUNT // 2 + 5) + "[]]")
    deep = "[" * DEEPEST + "]" * DEEPEST
    assert json.dumps(parse_json(deep)) == deep


@pytest.mark.skipif(os.name != "posix", reason="pipes as POSIX has them")
def test_a_pipe_in_the_place_of_metrics_json_does_not_block(tmp_path, little):
    os.mkfifo(tmp_path / "metrics.json")
    with pytest.raises(DudmapError, match="holds no state of a run"):
        resume(tmp_path)


@pytest.mark.parametrize("names", [["../secret.txt"], ["/etc/passwd"], [3], "trajectory.txt", {"a": 1}])
def test_merge_json_names_trajectories_of_its_folder_only(names, tmp_path):
    (tmp_path / "merge.json").write_text(json.dumps({"trajectories": names}))
    with pytest.raises(DudmapError, match=r"merge\.json"):
        save_trajectories(tmp_path / "out", [(tmp_path, np.eye(4))])


@pytest.mark.skipif(os.name != "posix", reason="links as POSIX has them")
@pytest.mark.parametrize("name", ["map", "tiles", ".work", "part-2"])
def test_a_world_folder_with_links_or_files_of_others(name, tmp_path):
    from dudmap.fleet.merge import _check_out

    others = tmp_path / "others"
    others.mkdir()
    for file in ("0000000000001.npz", "a.glb", "a.ply", "trajectory.txt"):
        (others / file).write_text("of somebody")
    world = tmp_path / "world"
    world.mkdir()
    (world / "world.json").write_text("{}")
    (world / name).symlink_to(others)
    with pytest.raises(DudmapError, match="is a link or no folder"):
        _check_out(world)
    assert len(list(others.iterdir())) == 4
    (world / name).unlink()
    (world / name).mkdir()
    (world / name / "notes.txt").write_text("of somebody")
    with pytest.raises(DudmapError, match="not empty"):
        _check_out(world)
    assert (world / name / "notes.txt").exists()
    (world / name / "notes.txt").unlink()
    (world / "world.json").write_text("{}")
    _check_out(world)
    assert list(world.iterdir()) == []


def test_gzip_is_known_by_its_content(tmp_path, monkeypatch):
    from layouts import tum, write

    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    folder, _ = write(tum, tmp_path / "a")
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as file:
        file.add(folder, "desk")
    (tmp_path / "desk.tar").write_bytes(content.getvalue())
    assert len(open_sequence(tmp_path / "desk.tar")) == 3
