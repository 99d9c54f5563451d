"""The folder of compiled kernels, and runs without one: no home folder, a read-only installation.

The subprocesses run a copy of the package in a read-only folder. Root may write everywhere, so that its processes give
up that right (setpriv) first.
"""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

import dudmap
from dudmap.core import formulas, kernel_cache, shipped_kernels
from dudmap.core.backends import threads
from dudmap.core.backends.cpu import filtering

DESK = Path(__file__).parent / "fixtures" / "freiburg1_xyz"
OBEYS = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """Runs Python with a read-only copy of dudmap and a read-only home; gives its result."""
    place = tmp_path_factory.mktemp("stranger")
    shutil.copytree(
        Path(dudmap.__file__).parent, place / "site" / "dudmap", ignore=shutil.ignore_patterns("__pycache__")
    )
    for name in ("home", "tmp"):
        (place / name).mkdir()
    folders = [place / "home", *(path for path in (place / "site").rglob("*") if path.is_dir()), place / "site"]
    for folder in folders:
        folder.chmod(0o555)
    own = {"HOME": place / "home", "TMPDIR": place / "tmp", "PYTHONPATH": place / "site", "DUDMAP_THREADS": 1}
    unset = {"NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "DUDMAP_CACHE", "MPLCONFIGDIR"}

    def call(*arguments, **environment):
        inherited = {name: value for name, value in os.environ.items() if name not in unset}
        given = inherited | {name: str(value) for name, value in (own | environment).items()}
        return subprocess.run([*OBEYS, sys.executable, *map(str, arguments)], env=given, capture_output=True, text=True)

    call.place = place
    try:
        probe = call("-c", f"open({str(place / 'home' / 'file')!r}, 'w')")
    except OSError as error:
        pytest.skip(f"a process without the rights of root cannot be started: {error}")
    if "Permission" not in probe.stderr:
        pytest.skip(f"this user can write into read-only folders: {probe.stderr}")
    yield call
    for folder in folders:
        folder.chmod(0o755)


def cache_of(done):
    return next(check for check in json.loads(done.stdout)["checks"] if check["name"] == "kernel cache")


def test_without_a_folder_for_kernels_all_starts_and_says_so_once(stranger):
    done = stranger("-c", "from dudmap import Slam, run")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    program = "import numpy; from dudmap.core.backends.cpu.filtering import pad, intensities; "
    program += "intensities(0, 1, numpy.ones((1, 1, 3), 'u1'), numpy.ones((1, 1), 'f4')); pad.stats.cache_path"
    done = stranger("-c", program)
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.count("KernelCacheWarning") == 1
    assert "NUMBA_CACHE_DIR" in done.stderr
    done = stranger("-m", "dudmap", "info", DESK)
    assert done.returncode == 0
    assert not done.stderr or len(done.stderr.splitlines()) == 1


def test_doctor_names_the_folder_that_is_used(stranger, tmp_path):
    private = stranger.place / "tmp" / f"dudmap-{os.getuid()}"
    done = stranger("-m", "dudmap", "doctor", "--json")
    assert str(private) in cache_of(done)["found"]
    assert "NUMBA_CACHE_DIR" in cache_of(done)["mend"]
    assert private.stat().st_mode & 0o777 == 0o700
    assert len(done.stderr.splitlines()) == 1
    done = stranger("-m", "dudmap", "doctor", "--json", HOME=tmp_path)  # Numba takes the user's folder
    assert f"{tmp_path}/.cache/numba" in cache_of(done)["found"]
    assert "every start" not in str(cache_of(done))
    assert not done.stderr
    done = stranger("-m", "dudmap", "doctor", "--json", NUMBA_CACHE_DIR=tmp_path / "given")
    assert str(tmp_path / "given") in cache_of(done)["found"]
    done = stranger("-m", "dudmap", "doctor", "--json", NUMBA_CACHE_DIR=stranger.place / "home", HOME=tmp_path)
    assert "cannot be written" in cache_of(done)["found"]
    assert "NUMBA_CACHE_DIR" in cache_of(done)["mend"]


def test_a_run_without_home_and_cache_gives_what_any_run_gives(stranger, tmp_path):
    for file in (filtering.__file__, threads.__file__, formulas.__file__):  # kernels that are already compiled
        kept = Path(kernel_cache._Locator.from_function(cache_of, file).get_cache_path())
        copied = stranger.place / "site" / Path(file).relative_to(Path(dudmap.__file__).parents[1])
        private = stranger.place / "tmp" / f"dudmap-{os.getuid()}"
        private.mkdir(mode=0o700, exist_ok=True)
        target = private / kernel_cache._PrivateLocator.get_suitable_cache_subpath(str(copied))
        shutil.copytree(kept, target, dirs_exist_ok=True)
    command = ["-m", "dudmap", "run", DESK, "--max-frames", 5, "--quiet", "--out"]
    there = stranger(*command, tmp_path / "there")
    assert there.returncode == 0, there.stderr
    here = subprocess.run(
        [sys.executable, *map(str, command), tmp_path / "here"], capture_output=True, text=True, check=True
    )
    assert (tmp_path / "there" / "report.html").stat().st_size > 0
    for name in ("trajectory.txt", "mesh.ply"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    assert len(there.stderr.splitlines()) == len(here.stderr.splitlines()) + 1
    assert not list((stranger.place / "home").iterdir())


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Defines a new kernel and returns the brightness of a white pixel by it."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    shipped_kernels._said.clear()

    def intensity():
        out = np.zeros((1, 1), np.float32)
        threads.kernel(filtering.intensities.py_func)(0, 1, np.full((1, 1, 3), 255, np.uint8), out)
        return out.item()

    yield intensity
    shipped_kernels._said.clear()


def test_kernels_are_compiled_in_memory_where_no_folder_can_be_written(kernel, monkeypatch):
    monkeypatch.setattr(kernel_cache._Locator, "from_function", lambda *_: None)
    with pytest.warns(kernel_cache.KernelCacheWarning, match=r"in memory.*NUMBA_CACHE_DIR") as said:
        values = kernel(), kernel()
    assert values == pytest.approx((1, 1))
    assert len(said) == 1
    assert (kernel_cache.folder(), kernel_cache.count()) == (None, 0)


def test_a_full_disk_does_not_end_a_compilation(kernel, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    with pytest.warns(kernel_cache.KernelCacheWarning, match="No space left"):
        assert kernel() == pytest.approx(1)


def test_a_damaged_file_of_the_cache_is_compiled_again(kernel, tmp_path):
    kernel()
    for path in (tmp_path / "cache").rglob("*.nb?"):
        path.write_bytes(b"")
    assert kernel() == pytest.approx(1)
    assert all(path.stat().st_size for path in (tmp_path / "cache").rglob("*.nbi"))


@pytest.mark.skipif(os.name != "posix", reason="elsewhere the temporary folder is not shared")
def test_a_folder_that_others_could_write_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    find, path = kernel_cache._private.__wrapped__, tmp_path / f"dudmap-{os.getuid()}"
    assert find() == path
    assert path.stat().st_mode & 0o777 == 0o700
    path.chmod(0o770)
    assert find() is None
    path.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    path.symlink_to(tmp_path / "elsewhere")
    assert find() is None
    path.unlink()
    tmp_path.chmod(0o777)  # without the sticky bit
    assert find() is None
    tmp_path.chmod(0o1777)
    assert find() == path
    monkeypatch.delenv("TMPDIR")  # the current folder, where Python finds no other
    assert find() is None
