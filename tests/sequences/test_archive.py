"""Archives: unpacked once, and everything refused that a recording does not hold."""

import io
import stat
import tarfile
import zipfile

import pytest

from dudmap.errors import DatasetError
from dudmap.io.sequences import archive, open_sequence
from layouts import tum, write


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def outside(tmp_path):
    """A file that no archive may touch."""
    path = tmp_path / "outside.txt"
    path.write_text("untouched")
    yield path
    assert path.read_text() == "untouched"


def zipped(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def refused(path, sentence, cache):
    with pytest.raises(DatasetError, match=sentence) as error:
        open_sequence(path)
    assert "\n" not in str(error.value)
    assert not list(cache.glob("*"))  # nothing is left behind


@pytest.mark.parametrize(
    "name", ["../outside.txt", "a/../../outside.txt", "/outside.txt", "..\\outside.txt", "C:\\x.txt"]
)
def test_paths_that_lead_out(name, tmp_path, cache, outside):
    refused(zipped(tmp_path / "a.zip", **{"rgb.txt": "", name: "evil"}), "leads out of the archive", cache)
    with tarfile.open(tmp_path / "a.tar", "w") as file:
        member = tarfile.TarInfo(name)
        member.size = 4
        file.addfile(member, io.BytesIO(b"evil"))
    refused(tmp_path / "a.tar", "leads out of the archive", cache)


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE])
def test_links_and_devices_of_a_tar(kind, tmp_path, cache, outside):
    with tarfile.open(tmp_path / "a.tgz", "w:gz") as file:
        member = tarfile.TarInfo("rgb.txt")
        member.type, member.linkname = kind, str(outside)
        file.addfile(member)
    refused(tmp_path / "a.tgz", r"holds rgb\.txt, a link or device", cache)


def test_links_of_a_zip(tmp_path, cache, outside):
    info = zipfile.ZipInfo("rgb.txt")
    info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr(info, str(outside))
    refused(tmp_path / "a.zip", r"holds rgb\.txt, a link or device", cache)


def test_a_bomb(tmp_path, cache):
    sentence = r"0\.1 MB\) unpacks to more than 67 MB, the least of 100 times its size, 256 GiB and the free space"
    refused(zipped(tmp_path / "a.zip", bomb=b"\0" * 66 * 2**20), sentence, cache)
    with tarfile.open(tmp_path / "b.tgz", "w:gz") as file:
        member = tarfile.TarInfo("bomb")
        member.size = 66 * 2**20
        file.addfile(member, io.BytesIO(b"\0" * member.size))
    refused(tmp_path / "b.tgz", r"unpacks to more than 67 MB", cache)


def test_a_bomb_that_understates_its_size(tmp_path, cache):
    path = zipped(tmp_path / "a.zip", bomb=b"\0" * 66 * 2**20)
    data = path.read_bytes().replace((66 * 2**20).to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    path.write_bytes(data)
    refused(path, "unpacks to more than|Bad CRC|cannot unpack", cache)


def test_too_many_members(tmp_path, cache, monkeypatch):
    monkeypatch.setattr(archive, "LARGEST_COUNT", 3)
    refused(zipped(tmp_path / "a.zip", a="", b="", c="", d=""), "more than 3 members", cache)


def test_damaged_archives(tmp_path, cache):
    for name in ("a.zip", "a.tar", "a.tgz"):
        (tmp_path / name).write_bytes(b"no archive at all")
        refused(tmp_path / name, "cannot unpack", cache)
    path = zipped(tmp_path / "b.zip", **{"rgb.txt": "x" * 5000})
    path.write_bytes(path.read_bytes()[:-30])
    refused(path, "cannot unpack", cache)


def test_an_archive_is_unpacked_once_and_again_when_it_changed(tmp_path, cache):
    folder, _ = write(tum, tmp_path / "a")

    def pack():
        with tarfile.open(tmp_path / "desk.tar.gz", "w:gz") as file:
            file.add(folder, "desk")

    pack()
    first = open_sequence(tmp_path / "desk.tar.gz")
    assert first.name == "desk"
    assert archive.origin(first.path) == (tmp_path / "desk.tar.gz").resolve()
    assert open_sequence(tmp_path / "desk.tar.gz").path == first.path
    (folder / "intrinsics.txt").write_text("fx 90\nfy 61\ncx 31\ncy 23\n")
    pack()
    assert open_sequence(tmp_path / "desk.tar.gz").camera.fx == 90


def test_two_processes_unpack_one_archive(tmp_path, cache, monkeypatch):
    path = zipped(tmp_path / "desk.zip", **{"rgb.txt": "of the second"})
    unpack_into = archive._unpack_into

    def overtaken(path, folder, packed):
        monkeypatch.setattr(archive, "_unpack_into", unpack_into)
        archive.unpack(path)  # the other process is done first
        unpack_into(path, folder, packed)

    monkeypatch.setattr(archive, "_unpack_into", overtaken)
    assert (archive.unpack(path) / "rgb.txt").read_text() == "of the second"
    assert [place.name for place in cache.iterdir()] == [archive.unpack(path).parent.name]  # nothing unfinished is left


def test_an_archive_of_something_else(tmp_path):
    with pytest.raises(DatasetError, match="is a folder in no known format"):
        open_sequence(zipped(tmp_path / "a.zip", readme="hello"))


def test_the_place_of_the_cache(tmp_path, monkeypatch):
    assert archive.cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("DUDMAP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert archive.cache_folder() == tmp_path / "xdg" / "dudmap"
