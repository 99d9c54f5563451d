"""Kernels that a wheel brings are used by whom they fit, and nothing but time is lost where they do not."""

import os
import subprocess
import sys
import warnings

import numba
import numpy as np
import pytest

from dudmap.core import kernel_cache, shipped_kernels
from dudmap.core.backends import threads
from dudmap.core.backends.cpu import filtering
from dudmap.core.shipped_kernels import KernelCacheWarning
from dudmap.errors import ConfigError
from dudmap.lab.wheel_kernels import SHIPPED, export

FORCED = """
import numpy as np
from dudmap.core.backends.cpu import filtering
filtering.intensities(0, 1, np.ones((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))
print(filtering.intensities.targetctx.codegen().magic_tuple()[1:])
(assembly,) = filtering.intensities.inspect_asm().values()
print("ymm" in assembly, "zmm" in assembly)
"""


@pytest.fixture
def brightness(tmp_path, monkeypatch):
    """Calls a new copy of a kernel that a wheel brings; gives the brightness of a white pixel, and where it is from."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(shipped_kernels, "FOLDER", tmp_path / "compiled")
    monkeypatch.setattr(shipped_kernels, "available", lambda: shipped_kernels.LEVELS["x86-64-v3"])
    shipped_kernels._said.clear()
    shipped_kernels.folder.cache_clear()

    def call(function=filtering.intensities.py_func):
        out, kernel = np.zeros((1, 1), np.float32), threads.kernel(function)
        before = kernel_cache.counts.copy()
        kernel(0, 1, np.full((1, 1, 3), 255, np.uint8), out)
        return out.item(), *(kernel_cache.counts - before)

    kernel = threads.kernel(filtering.intensities.py_func)
    kernel(0, 1, np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))
    place = tmp_path / "compiled" / shipped_kernels.VERSIONS
    for level in SHIPPED:
        (place / level).mkdir(parents=True)
    export(kernel, place / "x86-64-v3")
    for path in (tmp_path / "cache").rglob("*.nb?"):
        path.unlink()
    shipped_kernels.folder.cache_clear()
    shipped_kernels._said.clear()
    call.place = place
    yield call
    shipped_kernels.folder.cache_clear()
    shipped_kernels._said.clear()


def said(call, *arguments):
    """Result of a call and the sentences of its warnings."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        result = call(*arguments)
    assert all(one.category is KernelCacheWarning for one in found)
    return result, [str(one.message) for one in found]


def test_a_kernel_of_the_wheel_is_loaded_and_nothing_is_stored(brightness, tmp_path):
    assert said(brightness) == ((pytest.approx(1), "shipped"), [])
    assert not list((tmp_path / "cache").rglob("*.nb?"))
    assert not kernel_cache.is_cold()


@pytest.mark.parametrize(
    "damage", [lambda data: b"", lambda data: data[:-1], lambda data: data[:40] + b"?" + data[41:]]
)
def test_a_damaged_kernel_is_compiled_and_said_once(brightness, damage):
    (path,) = brightness.place.rglob("*.nbc")
    path.write_bytes(damage(path.read_bytes()))
    assert kernel_cache.is_cold() is False
    result, sentences = said(brightness)
    assert result == (pytest.approx(1), "compiled")
    assert len(sentences) == 1
    assert f"{path} is damaged" in sentences[0]
    assert said(brightness) == ((pytest.approx(1), "stored"), [])


def test_the_kernel_of_an_edited_source_is_compiled(brightness):
    def edited(row_start, row_stop, color, out):
        out[row_start, 0] = 2 * color[0, 0, 0]

    result, sentences = said(brightness, edited)
    assert result == (510, "compiled")
    assert len(sentences) == 1
    assert "edited was edited, or is called with other types" in sentences[0]


@pytest.mark.parametrize("name", ["cpython-39-numba-0.1-llvmlite-0.1", "unreadable"])
def test_kernels_of_other_versions_are_left_alone(brightness, name):
    brightness.place.rename(brightness.place.with_name(name))
    result, sentences = said(brightness)
    assert result == (pytest.approx(1), "compiled")
    assert len(sentences) == 1
    assert f"for {name}/x86-64-v3, {name}/x86-64-v4, not for {shipped_kernels.VERSIONS}/x86-64-v3" in sentences[0]
    assert numba.__version__ in shipped_kernels.VERSIONS


def test_the_highest_level_of_the_processor_is_chosen(brightness, monkeypatch):
    for level in SHIPPED:
        shipped_kernels.folder.cache_clear()
        monkeypatch.setattr(shipped_kernels, "available", lambda level=level: shipped_kernels.LEVELS[level] | {"gfni"})
        assert shipped_kernels.folder() == brightness.place / level
    shipped_kernels.folder.cache_clear()
    monkeypatch.setattr(shipped_kernels, "available", lambda: shipped_kernels.LEVELS["x86-64-v3"] - {"fma"})
    with pytest.warns(KernelCacheWarning, match=r"not for .*/generic; they are compiled here"):
        assert shipped_kernels.folder() is None


def test_kernels_for_a_processor_that_the_user_named_to_numba_are_compiled(brightness, monkeypatch):
    monkeypatch.setattr(numba.config, "CPU_NAME", "haswell")
    with pytest.warns(KernelCacheWarning, match=r"not for .*/haswell"):
        assert shipped_kernels.folder() is None


def test_a_clone_without_kernels_says_nothing(brightness, tmp_path, monkeypatch):
    monkeypatch.setattr(shipped_kernels, "FOLDER", tmp_path / "none")
    assert said(brightness) == ((pytest.approx(1), "compiled"), [])


def forced(level, program=FORCED, **environment):
    return subprocess.run(
        [sys.executable, "-c", program], env=os.environ | {"DUDMAP_CPU": level} | environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_level_is_forced(tmp_path):
    done = forced("generic", NUMBA_CACHE_DIR=str(tmp_path))
    assert done.stdout == "('generic', '')\nFalse False\n", done.stderr


def test_an_unknown_level_is_refused_by_name():
    done = forced("x86-64-v9", "import sys; sys.argv = ['dudmap', 'warmup']; from dudmap.cli import main; main()")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "DUDMAP_CPU=x86-64-v9" in line
    assert "generic, x86-64-v3, x86-64-v4" in line


def test_a_level_that_the_processor_does_not_have_is_refused(monkeypatch):
    monkeypatch.setattr(shipped_kernels, "available", lambda: shipped_kernels.LEVELS["x86-64-v3"])
    with pytest.raises(ConfigError, match=r"has no avx512bw, .*; set DUDMAP_CPU=generic"):
        shipped_kernels.force_level("x86-64-v4")
    assert numba.config.CPU_NAME is None


def test_a_level_that_is_forced_too_late_is_refused():
    done = forced("generic", "import numba; numba.njit(lambda: 1)(); from dudmap.core.backends import threads")
    assert "DUDMAP_CPU=generic comes too late" in done.stderr
