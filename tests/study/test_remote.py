"""Recordings behind a URL: fetched once per machine, whole or not at all."""

import multiprocessing
import shutil
import time
from functools import partial

import pytest

fsspec = pytest.importorskip("fsspec")

from dudmap.errors import ConfigError, DatasetError
from dudmap.lab.study.plan import make_plan
from dudmap.lab.study.remote import RemoteEntry, fetched
from recordings import write_recording

FACTORS = {"tracker.huber": [0.005, 0.01]}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def archive(tmp_path):
    folder = write_recording(tmp_path / "desk", 3)
    return shutil.make_archive(str(tmp_path / "desk"), "zip", folder)


def memory(content, name="desk.zip"):
    """URL of the memory file system that holds the content."""
    with fsspec.open(f"memory://{name}", "wb") as file:
        file.write(content)
    return f"memory://{name}"


def test_an_archive_behind_a_url_is_a_recording_like_the_folder(tmp_path, archive):
    with open(archive, "rb") as file:
        url = memory(file.read())
    plan = make_plan({"factors": FACTORS, "responses": ["lost"], "sequences": [{"path": url}]})
    plan.check()
    entry = plan.entries[0][2]
    assert entry.name == "desk"
    far, near = entry.open(), make_plan({"factors": FACTORS, "sequences": [{"path": str(tmp_path / "desk")}]})
    near = near.entries[0][2].open()
    assert len(far) == len(near)
    assert (far[1].depth == near[1].depth).all()
    fsspec.filesystem("memory").rm("desk.zip")
    assert len(entry.open()) == len(near)  # from the cache


def test_a_folder_behind_a_url(tmp_path):
    folder = write_recording(tmp_path / "desk", 3)
    entry = RemoteEntry("desk", url=f"file://{folder}")
    shutil.rmtree(tmp_path / "gone", ignore_errors=True)
    opened = entry.open()
    folder.rename(tmp_path / "gone")
    assert opened[2].depth.shape == entry.open()[2].depth.shape


def test_the_key_of_a_run_is_that_of_the_url_wherever_it_runs(archive, monkeypatch, tmp_path):
    def keys():
        tree = {"factors": FACTORS, "sequences": [{"path": f"file://{archive}"}]}
        return [run.key for run in make_plan(tree, tmp_path).runs()]

    before = keys()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUDMAP_CACHE", str(tmp_path / "another"))
    assert keys() == before
    other = make_plan({"factors": FACTORS, "sequences": [{"path": f"file://{archive}2"}]}).runs()
    assert not {run.key for run in other} & set(before)


def slow_get(self, source, to, count, **_):
    """Download that takes a while and is counted."""
    with open(count, "a", encoding="utf-8") as file:
        file.write("x")
    with open(to, "wb") as file:
        file.write(b"half")
        file.flush()
        time.sleep(0.3)
        file.write(b"half")


def fetch(url, count, queue):
    from fsspec.implementations.local import LocalFileSystem

    LocalFileSystem.get_file = lambda self, source, to, **rest: slow_get(self, source, to, count)
    with fetched(url) as path:
        queue.put(path.read_bytes())


def test_processes_of_one_machine_fetch_once_and_see_whole_files_only(tmp_path, archive):
    context = multiprocessing.get_context("spawn")
    queue, count = context.Queue(), tmp_path / "count"
    workers = [context.Process(target=fetch, args=(f"file://{archive}", str(count), queue)) for _ in range(3)]
    for worker in workers:
        worker.start()
    assert [queue.get(timeout=120) for _ in workers] == [b"halfhalf"] * 3
    for worker in workers:
        worker.join()
    assert count.read_text() == "x"


def test_what_a_killed_process_left_is_fetched_anew(tmp_path, archive, cache):
    context = multiprocessing.get_context("spawn")
    queue, count = context.Queue(), tmp_path / "count"
    worker = context.Process(target=partial(fetch, f"file://{archive}", str(count), queue))
    worker.start()
    while not count.is_file():
        time.sleep(0.01)
    worker.kill()
    worker.join()
    with fetched(f"file://{archive}") as path:
        assert path.stat().st_size > 100
    assert not list(cache.rglob(".part"))


@pytest.mark.parametrize(
    ("url", "error", "words"),
    [
        ("memory://nothing.zip", DatasetError, "there is nothing at memory://nothing.zip"),
        ("gopher7://host/desk.zip", DatasetError, "not a URL that fsspec can read"),
        ("s3://bucket/desk.zip", ConfigError, "s3fs"),
    ],
)
def test_a_url_that_cannot_be_read_is_one_sentence_before_anything_is_run(url, error, words):
    plan = make_plan({"factors": FACTORS, "responses": ["lost"], "sequences": [{"path": url}]})
    if "s3" in url:
        s3fs = __import__("importlib").util.find_spec("s3fs")
        if s3fs is not None:
            pytest.skip("s3fs is installed")
    with pytest.raises(error, match=words) as found:
        plan.check()
    assert "\n" not in str(found.value)
