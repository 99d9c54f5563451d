"""What differs between Linux, macOS and Windows. Only Linux runs these tests: the others are imitated, or read for."""

import ast
import os
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.app.pipeline import environment
from dudmap.app.viewing.page_access import port_problem
from dudmap.core.backends import threads

SOURCES = sorted((Path(__file__).parent.parent / "src" / "dudmap").rglob("*.py"))
POSIX_ONLY = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios"}


@cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def all_calls():
    """All calls of methods in the package, with their file."""
    nodes = ((path, node) for path in SOURCES for node in ast.walk(parsed(path)))
    return [(path, node) for path, node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]


def calls(name):
    """All calls of a method of this name in the package, with their file."""
    return ((path, node) for path, node in all_calls() if node.func.attr == name)


@pytest.mark.parametrize("name", ["read_text", "write_text"])
def test_text_files_are_utf8_everywhere(name):
    assert [path for path, call in calls(name) if "encoding" not in {word.arg for word in call.keywords}] == []


def test_no_image_is_opened_by_a_name_that_opencv_cannot_read_on_windows():
    assert [path for name in ("imread", "imwrite") for path, _ in calls(name)] == []


def test_no_module_needs_posix_when_it_is_imported():
    for path in SOURCES:
        for node in parsed(path).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not POSIX_ONLY & set(names), path


def test_no_process_is_forked():
    assert list(calls("fork")) == []
    for path, call in calls("get_context"):
        assert [argument.value for argument in call.args if isinstance(argument, ast.Constant)] == ["spawn"], path
    for path, call in calls("ProcessPoolExecutor"):
        assert "mp_context" in {word.arg for word in call.keywords} or len(call.args) > 1, path


@pytest.mark.parametrize(("platform", "expected"), [("darwin", 50.0), ("freebsd", 50000.0), ("win32", None)])
def test_peak_memory_has_one_unit(monkeypatch, platform, expected):
    import resource

    monkeypatch.setattr(Path, "is_file", lambda _: False)  # no /proc
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(resource, "getrusage", lambda _: SimpleNamespace(ru_maxrss=50_000_000))  # macOS: bytes
    assert environment.peak_rss_mb() == expected


def test_cores_are_counted_without_affinity(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.delenv("DUDMAP_THREADS", raising=False)
    monkeypatch.setattr(threads, "_num_cores", threads._num_cores.__wrapped__)  # without what it has counted before
    assert threads.num_threads.__wrapped__() == environment.machine()["cores_usable"] == os.cpu_count()


@pytest.mark.parametrize("platform", ["linux", "win32"])
def test_a_port_in_use_is_refused(monkeypatch, platform):
    monkeypatch.setattr(sys, "platform", platform)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert "in use" in port_problem("127.0.0.1", other.getsockname()[1])


def test_output_that_the_terminal_cannot_show_is_no_error(tmp_path):
    environment_ = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    program = "import sys; sys.argv[1:] = ['--help']; from dudmap import cli; cli.app.info.help = 'größer'; cli.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment_, check=False)
    assert done.returncode == 0, done.stderr
    assert b"?" in done.stdout


def test_a_recording_in_a_folder_with_any_name(tmp_path):
    from dudmap.lab import synthetic
    from dudmap.lab.synthetic.folder import write_folder

    folder = write_folder(synthetic.sequence("room", movers=(), frames=1), tmp_path / "größe ✓", surface=False)
    from dudmap import open_sequence

    assert np.any(open_sequence(folder)[0].depth > 0)
