"""A compiled kernel is valid until its text, or that of anything that enters it, changes."""

import ast
import importlib
import inspect
import pkgutil
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from types import CodeType

import numpy as np
import pytest
from numba import typeof
from numba.core.dispatcher import Dispatcher

import dudmap
from dudmap.core.backends.cpu import filtering
from dudmap.core.backends.parameters import SensorNoise
from dudmap.core.kernel_digest import _read, digest, layout

PACKAGES = "dudmap.core.backends.cpu", "dudmap.core.formulas", "dudmap.lab.synthetic.kernels", "dudmap.thesis.kernels"
LISTED = """
import importlib, sys
from dudmap.core.kernel_digest import digest
for name in sys.argv[1:]:
    module, _, kernel = name.rpartition(".")
    print(digest(getattr(importlib.import_module(module), kernel)))
"""
EDITS = [
    ("config.py", "base + scale * (z * z)", "base + scale * z", "fusion.fuse"),
    ("core/geometry/se3.py", "SMALL = 1e-8", "SMALL = 1e-7", "registration.descend"),
    ("core/backends/cpu/vectors.py", "WIDTH = 512", "WIDTH = 256", "registration.descend"),
    ("core/backends/cpu/teams.py", '"add", builder', '"sub", builder', "registration.descend"),
]


def kernels():
    """Everything that Numba compiles, by the function that it compiles."""
    found = {}
    for package in PACKAGES:
        for part in pkgutil.iter_modules(importlib.import_module(package).__path__):
            for value in vars(importlib.import_module(f"{package}.{part.name}")).values():
                value = getattr(value, "inlined", value)
                if isinstance(value, Dispatcher):
                    found[value.py_func] = value
    return found


def text(function):
    return ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]


def called(function):
    """Functions that the text of a function names and Numba compiles."""
    names = {node.id for node in ast.walk(text(function)) if isinstance(node, ast.Name)}
    values = (function.__globals__.get(name) for name in names)
    found = (getattr(value, "py_func", getattr(value, "_defn", None)) for value in values)
    return {one for one in found if one is not None} - {function}


def edited(function):
    """Code of a function to whose text a statement is added."""
    definition = text(function)
    definition.decorator_list = []
    definition.body.insert(0, ast.parse("added = 12345").body[0])
    module = compile(ast.fix_missing_locations(ast.Module([definition], [])), "edited", "exec")
    return next(constant for constant in module.co_consts if isinstance(constant, CodeType))


def test_an_edit_of_a_function_changes_each_kernel_that_inlines_it(monkeypatch):
    found, far = kernels(), set()
    for function, kernel in found.items():
        for inlined in called(function):
            before = digest(kernel), digest(found.get(inlined, kernel))
            with monkeypatch.context() as patch:
                patch.setattr(inlined, "__code__", edited(inlined))
                _read.cache_clear()
                assert digest(kernel) != before[0], (function, inlined)
                assert digest(found.get(inlined, kernel)) != before[1]  # so that the callers' callers change as well
            _read.cache_clear()
            assert digest(kernel) == before[0]
            far.add(inlined.__module__)
    assert len(found) > 200
    assert {"dudmap.config", "dudmap.core.geometry.se3", "dudmap.core.backends.median"} <= far


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """Digests of kernels in a copy of the package, after an edit of one of its files."""
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(Path(dudmap.__file__).parent, site / "dudmap", ignore=shutil.ignore_patterns("__pycache__"))

    def digests(file, old, new, *kernels):
        path = site / "dudmap" / file
        before = path.read_text(encoding="utf-8")
        assert old in before
        path.write_text(before.replace(old, new), encoding="utf-8")
        command = [sys.executable, "-B", "-c", LISTED, *(f"dudmap.core.backends.cpu.{name}" for name in kernels)]
        done = subprocess.run(command, env={"PYTHONPATH": str(site)}, capture_output=True, text=True, check=True)
        path.write_text(before, encoding="utf-8")
        return done.stdout.split()

    return digests


@pytest.mark.parametrize(("file", "old", "new", "kernel"), EDITS)
def test_an_edit_anywhere_in_a_copy_changes_the_kernels_that_it_enters_and_no_others(copied, file, old, new, kernel):
    here = [digest(getattr(importlib.import_module(f"dudmap.core.backends.cpu.{name.split('.')[0]}"),
                           name.split(".")[1])) for name in (kernel, "filtering.pad")]  # fmt: skip
    there = copied(file, old, new, kernel, "filtering.pad")
    assert there[0] != here[0]
    assert there[1] == here[1]


def test_a_comment_a_docstring_and_a_moved_line_change_no_digest(copied):
    old, new = '"""Loops over', '# a comment\n\n"""Passes over'
    assert copied("core/backends/cpu/filtering.py", old, new, "filtering.pad") == [digest(filtering.pad)]


def test_the_order_of_the_fields_of_an_argument_counts():
    noise = typeof(SensorNoise(*np.ones(3, np.float32)))
    assert "('base', 'scale', 'reference')" in layout((noise, typeof(1)))


def test_a_value_that_the_digest_does_not_know_is_refused():
    unknown = {"of": "a kernel"}
    with pytest.raises(TypeError, match="one reads a dict"):
        digest(lambda: unknown)
