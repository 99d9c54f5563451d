"""Hostile files end in a result or in one sentence of ours: found cases, a few hundred random ones, and by hand."""

import ast
import io
import json
import os
import re
import sqlite3
import struct
import tarfile
import time
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loaders import LOADERS
from mutations import png
from recording_loaders import CAMERA
from trial import Finding, Subject, TooSlow
from verdict import check_sentence

import layouts
from dudmap.errors import DatasetError, DudmapError, FrameError, MapError
from dudmap.input_files import load_array, open_arrays, parse_json, parse_toml, read_text
from dudmap.sequences import images, open_sequence

CORPUS = Path(__file__).parent / "corpus"
SOURCE = Path(__file__).parents[2] / "src" / "dudmap"


def slug(name):
    return re.sub(r"\W+", "-", name)


@pytest.fixture(scope="module")
def subjects(tmp_path_factory):
    """Valid inputs by the name of their loader, written when first asked for."""
    made = {}

    def subject(name):
        if name not in made:
            if name == "record3d":
                pytest.importorskip("lzfse")
            if "bag" in name or "RealSense" in name:
                pytest.importorskip("rosbags")
            made[name] = Subject(name, tmp_path_factory.mktemp("fuzz") / "a")
        return made[name]

    before = os.environ.get("DUDMAP_CACHE")
    yield subject
    os.environ.pop("DUDMAP_CACHE", None)
    if before is not None:
        os.environ["DUDMAP_CACHE"] = before


@pytest.mark.parametrize("name", LOADERS)
def test_random_inputs(name, subjects):
    """The same inputs in every run; ``make fuzz`` reads many more."""
    subject = subjects(name)
    subject.warm_up()

    @settings(
        max_examples=3 if subject.loader.slow else 12, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.integers(0, 2**32))
    def read(seed):
        subject.trial(seed)

    read()


CASES = sorted(path for path in CORPUS.glob("*/*"))


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_found_cases(case, subjects):
    """Files that made a loader fail before it was mended."""
    name = next(name for name in LOADERS if slug(name) == case.parent.name)
    subject = subjects(name)
    try:
        for file in case.rglob("*"):
            if file.is_file():
                (subject.home / file.relative_to(case)).write_bytes(file.read_bytes())
        subject.read()
    finally:
        subject.restore()


def test_there_are_found_cases():
    assert len(CASES) > 20


class Wrong:
    """Loaders that do what they must not do."""

    @staticmethod
    def fails(path):
        raise ZeroDivisionError

    @staticmethod
    def hangs(path):
        time.sleep(60)

    @staticmethod
    def writes(path):
        (path.parent / "left-behind").write_text("")

    @staticmethod
    def mumbles(path):
        error = DatasetError("")
        error.args = ("two\nlines",)
        raise error


@pytest.mark.parametrize("way", ["fails", "hangs", "writes", "mumbles"])
def test_the_harness_finds_what_it_looks_for(way, tmp_path, monkeypatch):
    import trial

    monkeypatch.setattr(trial, "SECONDS", 0.2)
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path))
    subject = Subject("trajectory", tmp_path / "a")
    object.__setattr__(subject, "loader", type(subject.loader)(subject.loader.write, getattr(Wrong, way)))
    with pytest.raises((Finding, AssertionError)):
        subject.read()


# -- by hand -----------------------------------------------------------------------------------------------------------


def refused(call, kind=DudmapError, match=None):
    """``call`` ends at once with one sentence."""
    start = time.monotonic()
    with pytest.raises(kind, match=match) as error:
        call()
    check_sentence(error.value)
    assert time.monotonic() - start < 10


@pytest.mark.parametrize("what", ["fifo", "/dev/zero", "loop", "folder"])
@pytest.mark.parametrize("name", ["rgb.txt", "depth/100.000000.png", "intrinsics.txt", "groundtruth.txt"])
def test_what_is_no_plain_file(what, name, tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path)
    file = folder / name
    file.unlink()
    if what == "fifo":
        os.mkfifo(file)
    elif what == "folder":
        file.mkdir()
    else:
        file.symlink_to(file if what == "loop" else what)

    def read():
        sequence = open_sequence(folder)
        for index in range(len(sequence)):
            sequence[index]
        raise DatasetError("it is read without this file")

    refused(read)


@pytest.mark.parametrize("suffix", [".klg", ".sens", ".r3d", ".bag", ".db3", ".mcap", ".zip", ".tar", ".tgz"])
def test_a_pipe_in_the_place_of_a_recording(suffix, tmp_path):
    os.mkfifo(tmp_path / f"a{suffix}")
    refused(lambda: open_sequence(tmp_path / f"a{suffix}", CAMERA))


def test_a_billion_declared_frames(tmp_path):
    (tmp_path / "a.klg").write_bytes(struct.pack("<i", 10**9) + struct.pack("<qii", 0, 0, 0) * 3)
    refused(lambda: open_sequence(tmp_path / "a.klg", CAMERA), match="says 1000000000 frames and holds 3")
    header = struct.pack("<IQ", 4, 0) + struct.pack("<64f", *np.tile(np.eye(4).ravel(), 4))
    header += struct.pack("<2i", 1, 1) + struct.pack("<4I", 64, 48, 64, 48) + struct.pack("<fQ", 1000.0, 10**9)
    (tmp_path / "a.sens").write_bytes(header)
    refused(lambda: open_sequence(tmp_path / "a.sens"), match="cut off")


@pytest.mark.parametrize("size", [(60000, 60000), (2**31 - 1, 2**31 - 1), (0, 5), (2**27, 1)])
def test_huge_images(size):
    header = struct.pack(">II", *size) + bytes((8, 0, 0, 0, 0))
    data = png([(b"IHDR", header), (b"IDAT", zlib.compress(bytes(2**16))), (b"IEND", b"")])
    refused(lambda: images.decode_color(data, "a.png"), FrameError, "pixels; expected 67 million or less")


def test_a_progressive_image_of_ten_thousand_passes():
    data = layouts.cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8), [layouts.cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1]
    data = data.tobytes()
    start = data.rindex(b"\xff\xda")
    refused(
        lambda: images.decode_color(data[:-2] + data[start:-2] * 10_000 + b"\xff\xd9", "a.jpg"), FrameError, "header"
    )


def test_formats_that_are_not_needed_are_not_decoded():
    for data in (b"#?RADIANCE\n", b"\0\0\0\x0cjP  \r\n\x87\n", b"GIF89a", b"v/1\x01", b"<svg>", b"P7\n"):
        refused(
            lambda data=data: images.decode_color(data + bytes(100), "a"),
            FrameError,
            "not an image that can be decoded",
        )


@pytest.mark.parametrize("extension", ["png", "jpg", "tiff", "bmp", "webp", "pgm", "ppm"])
def test_formats_that_are_needed_are_decoded(extension):
    image = np.arange(20 * 30 * 3, dtype=np.uint8).reshape(20, 30, 3)
    image = image[..., 0].copy() if extension == "pgm" else image
    data = layouts.cv2.imencode(f".{extension}", image)[1].tobytes()
    assert images.decode_color(data, "a").shape == (20, 30, 3)


def npz(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def npy(header, body=b""):
    header = header.encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + body


@pytest.mark.parametrize(
    ("descr", "shape", "match"),
    [("'<f4'", "(1000000000, 1000)", "declares"), ("'|O'", "(1,)", "expected numbers"),
     ("[('a', '|O')]", "(1,)", "expected numbers"), ("'<U0'", "(1000000000000,)", "expected numbers"),
     ("'<f4'", "(-1,)", "whole numbers"), ("'<f4'", "(1.5,)", "."), ("__import__('os')", "()", "malformed")],
)  # fmt: skip
def test_arrays_that_declare_more_than_they_hold(descr, shape, match, tmp_path):
    data = npy(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", bytes(8))
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match=match):
        load_array(tmp_path / "a.npy")
    with open_arrays(npz(tmp_path / "a.npz", {"x": data})) as arrays, pytest.raises(ValueError, match=match):
        arrays["x"]


def test_an_archive_of_arrays_that_is_a_bomb(tmp_path):
    header = "{'descr': '|u1', 'fortran_order': False, 'shape': (300000000,), }"
    path = npz(tmp_path / "map.npz", {"format": npy(header, bytes(300_000_000))})
    assert path.stat().st_size < 400_000
    from dudmap.mapping.volume import TsdfVolume

    refused(lambda: TsdfVolume.load(path), MapError, "unpack to 300000")


def test_arrays_are_what_numpy_saved(tmp_path):
    arrays = {
        "a": np.arange(24.0).reshape(2, 3, 4), "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "c": np.array("text"), "d": np.zeros((0, 3), np.float16), "e": np.array(3.5), "f": np.array([True, False]),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    with open_arrays(tmp_path / "a.npz") as found:
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)
            assert found[name].flags.writeable


@pytest.mark.parametrize("depth", [2_000, 200_000])
def test_deep_nesting(depth, tmp_path):
    for text in ("[" * depth, '{"a":' * depth, "[" * depth + "]" * depth):
        with pytest.raises(ValueError, match=r".+"):
            parse_json(text)
    for text in ("a = " + "[" * depth, "a = " + "{a=" * depth, "[a" + ".a" * min(depth, 2000) + "."):
        with pytest.raises(ValueError, match=r".+"):
            parse_toml(text)


def test_names_with_line_breaks(tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path / "a\nb\x1b[2J")
    assert len(open_sequence(folder)) == 3
    (folder / "depth.txt").write_text("nonsense")
    refused(lambda: open_sequence(folder), DatasetError, r"a\\nb\\x1b\[2J")


def test_a_list_that_leads_elsewhere_does_not_show_what_is_there(tmp_path):
    folder, _ = layouts.write(layouts.tum, tmp_path / "x")
    (tmp_path / "secret.txt").write_text("a secret")
    (folder / "depth.txt").write_text("".join(f"{100 + 0.1 * k} ../../secret.txt\n" for k in range(3)))
    with pytest.raises(DatasetError) as error:
        open_sequence(folder)
    assert "a secret" not in str(error.value)


def test_a_program_in_the_place_of_a_table(tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x FROM n"
        )
    database.close()
    refused(lambda: open_sequence(path), DatasetError, "neither a plain table nor an index")


def test_bombs_in_bags(monkeypatch):
    pytest.importorskip("rosbags")
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap

    from dudmap.sequences import bag_limits

    monkeypatch.setattr(bag_limits, "LARGEST_CHUNK", 2**20)
    bag_limits.limit_decompression()
    zeros = {n: bytes(n) for n in (2**20, 2**20 + 1)}
    packers = {
        "bz2": (bz2.compress, ros1.decompressors["bz2"]), "lz4": (lz4.frame.compress, ros1.decompressors["lz4"]),
        "zstd": (storage_mcap.zstd.compress, lambda data: storage_mcap.DECOMPRESSORS["zstd"](data, 0)),
    }  # fmt: skip
    for pack, unpack in packers.values():
        assert unpack(pack(zeros[2**20])) == zeros[2**20]
        with pytest.raises(ValueError, match="unpacks to more than"):
            unpack(pack(zeros[2**20 + 1]))


def test_a_bomb_in_a_phone_recording():
    lzfse = pytest.importorskip("lzfse")
    from dudmap.sequences.record3d import largest_unpacked

    for data in (b"", b"a", np.linspace(0, 1, 20_000, dtype=np.float32).tobytes(), bytes(100_000), os.urandom(30_000)):
        assert largest_unpacked(lzfse.compress(data)) >= len(data)
    block = struct.pack("<4sI3Q", b"bvx2", 10, 10_000 << 40, 0, 32)
    assert largest_unpacked(block * 10 + b"bvx$") == 10 * 10_000 * 2674
    with pytest.raises(ValueError, match="cut off"):
        largest_unpacked(block)
    with pytest.raises(ValueError, match="no block"):
        largest_unpacked(b"bvx1" + bytes(100))


@pytest.mark.parametrize(
    ("array", "change"),
    [("entries", lambda a: a + 1000), ("entries", lambda a: a * 0), ("entries", lambda a: -a),
     ("coords", lambda a: a * 0), ("coords", lambda a: a + 2**20), ("geometry", lambda a: a[:, :7]),
     ("geometry", lambda a: a.astype(np.int64)),
     ("colors", lambda a: a[:-1]), ("free_count", lambda a: a[:-1]), ("camera", lambda a: a * np.nan),
     ("image", lambda a: a * 10**6), ("depth_max", lambda a: np.array(np.inf)), ("depth_max", lambda a: np.array(1e30)),
     ("depth_max", lambda a: np.array(-1.0)), ("config", lambda a: np.array('{"voxel_size": 1e-9}'))],
)  # fmt: skip
def test_maps_whose_arrays_do_not_fit(array, change, tmp_path, subjects):
    from dudmap.mapping.volume import TsdfVolume

    with open_arrays(subjects("map").path) as found:
        content = {name: np.array(found[name]) for name in found}
    np.savez(tmp_path / "map.npz", **content)
    TsdfVolume.load(tmp_path / "map.npz")
    content[array] = change(content[array])
    np.savez(tmp_path / "map.npz", **content)
    refused(lambda: TsdfVolume.load(tmp_path / "map.npz"), DudmapError)


@pytest.mark.parametrize(
    ("array", "change"),
    [("slot_coords1", lambda a: a + 1000), ("slot_coords1", lambda a: a[:-1]), ("slot_coords1", lambda a: a * 0),
     ("geometry1", lambda a: a[:, :7]), ("colors1", lambda a: a.astype(np.float32))],
)  # fmt: skip
def test_smaller_voxels_that_do_not_fit_their_map(array, change, tmp_path, subjects):
    from dudmap.mapping.volume import TsdfVolume

    with open_arrays(subjects("adaptive map").path) as found:
        content = {name: np.array(found[name]) for name in found}
    content[array] = change(content[array])
    np.savez(tmp_path / "map.npz", **content)
    refused(lambda: TsdfVolume.load(tmp_path / "map.npz"), MapError)


def test_a_tar_that_says_it_is_larger(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        member = tarfile.TarInfo("rgb.txt")
        member.size = 0
        archive.addfile(member, io.BytesIO())
    data = bytearray(out.getvalue())
    data[124:136] = b"77777777777\0"
    data[148:156] = b"%06o\0 " % (sum(data[:148]) + 8 * 32 + sum(data[156:512]))
    (tmp_path / "a.tar").write_bytes(data)
    refused(lambda: open_sequence(tmp_path / "a.tar"))


def test_a_text_that_is_too_large(tmp_path):
    with (tmp_path / "a.txt").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match="more than 268 MB"):
        read_text(tmp_path / "a.txt")


def test_numbers_beyond_64_bit():
    assert parse_json("[1" + "0" * 400 + "]") == [float("inf")]
    assert parse_json("[12]") == [12]
    assert json.loads("[12]") == [12]


# -- the source --------------------------------------------------------------------------------------------------------

FORBIDDEN = {"eval", "exec", "compile", "__import__"}
MODULES = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}


def trees():
    for path in sorted(SOURCE.rglob("*.py")):
        yield path.relative_to(SOURCE), ast.parse(path.read_text(encoding="utf-8"))


def test_nothing_that_is_read_can_run():
    """No pickle, no eval, no shell, and ``np.load`` without objects, in all of the source."""
    wrong = []
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = (
                    {alias.name.partition(".")[0] for alias in node.names} if isinstance(node, ast.Import) else set()
                )
                names |= {(node.module or "").partition(".")[0]} if isinstance(node, ast.ImportFrom) else set()
                wrong += [f"{path}:{node.lineno} imports {name}" for name in names & MODULES]
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            if name in FORBIDDEN or name in ("os.system", "os.popen") or options.get("shell") == "True":
                wrong.append(f"{path}:{node.lineno} calls {name}")
            if name in ("np.load", "numpy.load") and options.get("allow_pickle") != "False":
                wrong.append(f"{path}:{node.lineno} calls {name} without allow_pickle=False")
    assert wrong == []


READERS = ("sequences", "geometry", "mapping", "places", "calibration", "viewing", "exporting", "evaluation")
EXCEPTIONS = {"report.py", "memory_limit.py"}
"""Read the page's own template, and what the system says of the process."""


def test_files_from_elsewhere_are_opened_in_one_place():
    wrong = []
    for path, tree in trees():
        if path.parts[0] not in READERS or path.name in EXCEPTIONS:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr in ("read_text", "read_bytes", "loadtxt", "genfromtxt", "imread"):
                    wrong.append(f"{path}:{node.lineno} {ast.unparse(node.func)}")
                if ast.unparse(node.func) in ("np.load", "json.loads", "json.load", "tomllib.loads", "tomllib.load"):
                    wrong.append(f"{path}:{node.lineno} {ast.unparse(node.func)}")
    assert [line for line in wrong if "ORIGIN" not in line] == []


def test_too_slow_cannot_be_swallowed():
    assert not issubclass(TooSlow, Exception)
