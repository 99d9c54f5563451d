"""A run folder from elsewhere, or one that holds files of others, costs nothing outside of it and nothing of others."""

import errno
import os
from pathlib import Path

import pytest

from dudmap.app.pipeline.resume import resume
from dudmap.app.pipeline.run import run
from dudmap.app.pipeline.run_folder import LOCK, WRITTEN, run_lock
from dudmap.app.state.database import StateDatabase
from dudmap.app.viewing.report import Thumbnails
from dudmap.atomic_file import atomic_file, atomic_path, write_bytes, write_text
from dudmap.config import Config
from dudmap.errors import DudmapError
from dudmap.io.sequences import open_sequence
from dudmap.own_folder import OwnFolder
from recordings import write_recording

posix = pytest.mark.skipif(os.name != "posix", reason="links and pipes as POSIX has them")


@pytest.fixture
def elsewhere(tmp_path):
    """Files of somebody, which stay as they are."""
    (tmp_path / "elsewhere").mkdir()
    for name in ("file", "100.000000.png", "100.000000.color.jpg", "1.ply", "a.png", "a.jpg"):
        (tmp_path / "elsewhere" / name).write_text("of somebody")
    before = content(tmp_path / "elsewhere")
    yield tmp_path / "elsewhere"
    assert content(tmp_path / "elsewhere") == before


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def go(tmp_path):
    sequence = open_sequence(write_recording(tmp_path / "desk", 4)) if not (tmp_path / "desk").exists() else (
        open_sequence(tmp_path / "desk"))  # fmt: skip
    return run(sequence, Config(), tmp_path / "out", progress=False, save_masks=True, observers=(Thumbnails(),))


@posix
@pytest.mark.parametrize("act", [go, lambda tmp_path: resume(tmp_path / "out")], ids=["run", "resume"])
@pytest.mark.parametrize("name", [".lock", "masks", "thumbnails", "movers"])
def test_a_link_in_a_run_folder_leads_nowhere(name, act, slam, elsewhere, tmp_path):
    (tmp_path / "out").mkdir()
    target = elsewhere / "file" if name == ".lock" else elsewhere
    (tmp_path / "out" / name).symlink_to(target)
    with pytest.raises(DudmapError, match=f"{name} is a link or no .*; remove it, or name another folder"):
        act(tmp_path)
    assert (tmp_path / "out" / name).is_symlink()


@posix
@pytest.mark.parametrize("kind", ["hard link", "pipe", "folder"])
def test_a_lock_that_is_no_file_of_its_own(kind, elsewhere, tmp_path):
    lock = tmp_path / LOCK
    if kind == "hard link":
        os.link(elsewhere / "file", lock)
    elif kind == "pipe":
        os.mkfifo(lock)
    else:
        lock.mkdir()
    with pytest.raises(OSError, match="no plain file") as error:
        with run_lock(tmp_path):
            pass
    assert error.value.filename == str(lock)


@posix
@pytest.mark.parametrize("name", ["trajectory.txt", "state.db", "mesh-2.ply", "masks/100.000000.png"])
def test_links_in_the_place_of_results_are_not_followed(name, slam, elsewhere, tmp_path):
    (tmp_path / "out/masks").mkdir(parents=True)
    (tmp_path / "out" / name).symlink_to(elsewhere / "file")
    with pytest.raises(DudmapError, match="is a link or no plain file"):
        go(tmp_path)


@posix
def test_a_link_that_appears_later_is_replaced_and_not_followed(elsewhere, tmp_path):
    for name in ("a.txt", f".a.{os.getpid()}.part.txt"):
        (tmp_path / name).symlink_to(elsewhere / "file")
    write_text(tmp_path / "a.txt", "ours")
    assert (tmp_path / "a.txt").read_text() == "ours"
    (tmp_path / "masks").symlink_to(elsewhere)
    with pytest.raises(OSError, match="masks is a link"):
        write_bytes(tmp_path / "masks" / "100.000000.png", b"ours", own=True)
    (tmp_path / "state.db").symlink_to(elsewhere / "file")
    with pytest.raises(OSError, match=r"state\.db is a link"):
        StateDatabase(tmp_path / "state.db")


def test_only_names_that_a_run_gives_are_deleted(slam, tmp_path):
    out = tmp_path / "out"
    go(tmp_path)
    ours = {path for path in out.rglob("*") if path.is_file()}
    for path in ours:  # the list is complete
        folder = "" if path.parent == out else path.parent.name
        with OwnFolder(path.parent) as place:
            assert path.name in place.files(WRITTEN[folder])
    others = [out / "photo.png", out / "masks/holiday.png", out / "thumbnails/me.jpg", out / "mesh-of-mine.ply"]
    for path in others:
        path.write_text("of somebody")
    (out / "masks/0.000000.png").write_text("of an earlier run")
    go(tmp_path)
    assert [path.read_text() for path in others] == ["of somebody"] * 4
    assert not (out / "masks/0.000000.png").exists()


@pytest.mark.parametrize("manager", [atomic_file, atomic_path])
def test_a_full_disk_names_the_file(manager, tmp_path):
    with pytest.raises(OSError, match="No space left") as error, manager(tmp_path / "mesh.ply"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert error.value.filename == str(tmp_path / "mesh.ply")
    with pytest.raises(OSError, match="10 requested and 3 written") as error, manager(tmp_path / "map.npz"):
        raise OSError("10 requested and 3 written")  # as NumPy says it
    assert error.value.filename == str(tmp_path / "map.npz")


@posix
def test_a_full_device(tmp_path, monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    monkeypatch.setattr(OwnFolder, "create", lambda self, name: os.open("/dev/full", os.O_WRONLY))
    with pytest.raises(OSError, match="No space left on device") as error:
        write_text(tmp_path / "config.toml", "a" * 100_000)
    assert error.value.filename == str(tmp_path / "config.toml")
