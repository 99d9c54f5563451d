"""The first run, which compiles the kernels, gives what later ones give, which load them."""

import ast
import gc
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import event

import dudmap
from dudmap.core import kernel_cache
from dudmap.core.backends import threads
from dudmap.core.backends.cpu import filtering
from dudmap.core.faster_compiling import change_numba
from dudmap.lab import warmup

PROGRAM = """
import sys
from dudmap import Config, run, synthetic
from dudmap.core.geometry.camera import Camera
from dudmap.lab.synthetic.faults import SensorFaults

camera = Camera(262.0, 262.0, 159.5, 119.5, 320, 240)
faults = SensorFaults(color_delay=0.02, color_distortion=(0.1, -0.1, 0.0, 0.0))
recording = synthetic.sequence(frames=100, camera=camera, camera_path="handheld", faults=faults)
run(recording, Config().override(["volume.voxel_size=0.02"]), sys.argv[1], calibrate=True, progress=False)
"""
INTEGERS = {"_voxel", "inside_window", "load_corners"}
"""Kernels whose arithmetic has no roundings: on integers, or by powers of two."""


@pytest.mark.slow
def test_an_empty_and_a_filled_kernel_cache_give_equal_results(tmp_path):
    results = []
    for name in ("cold", "warm"):
        out = tmp_path / name
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        subprocess.run([sys.executable, "-c", PROGRAM, str(out)], check=True, env=environment, capture_output=True)
        results.append({file: (out / file).read_bytes() for file in ("trajectory.txt", "calibration.toml", "mesh.ply")})
    assert results[0] == results[1]


def test_a_kernel_is_compiled_again_when_its_digest_has_changed(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    for stamp, loaded in (("first", 0), ("first", 1), ("second", 0), ("second", 1)):
        monkeypatch.setattr(kernel_cache, "digest", lambda kernel, stamp=stamp: stamp)
        twice = threads.kernel(filtering.intensities.py_func)
        twice(0, 1, np.ones((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))
        assert sum(twice.stats.cache_hits.values()) == loaded


def test_what_kernels_call_is_inlined():
    """A function that is not exists twice, with other roundings, and it depends on the cache which one is called."""
    kinds, calls = {}, set()
    for path in sorted(Path(dudmap.__file__).parent.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        modules = {name.name: (node.module or "").rpartition(".")[2] for node in imports for name in node.names}
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                kind = {one.id for one in node.decorator_list if isinstance(one, ast.Name)}
                if kind & {"kernel", "scalar", "written_out", "exact", "exact_scalar"}:
                    kinds[path.stem, node.name] = kind
                    called = (one.func for one in ast.walk(node) if isinstance(one, ast.Call))
                    names = {one.id for one in called if isinstance(one, ast.Name)}
                    calls |= {(modules.get(name, path.stem), name) for name in names}
    assert ("color_pairs", "linearize_pair") in calls
    assert {call[1] for call in calls if kinds.get(call, set()) & {"kernel", "exact"}} == INTEGERS


def test_kernels_of_the_first_frames_do_not_compile_what_takes_seconds():
    """A selection or a sort by NumPy, and an array assigned to a part of another, whose error messages are compiled."""
    slow, found, kernels = {"partition", "sort", "argsort", "unique", "median", "percentile"}, set(), 0
    for path in sorted((Path(dudmap.__file__).parent / "core" / "backends" / "cpu").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef):
                continue
            marks = {one.id for one in node.decorator_list if isinstance(one, ast.Name)}
            if marks & {"kernel", "scalar", "exact", "exact_scalar"}:
                kernels += 1
                called = {
                    one.func.attr
                    for one in ast.walk(node)
                    if isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute)
                }
                found |= {(node.name, name) for name in called & slow}
                found |= {
                    (node.name, ast.unparse(one))
                    for one in ast.walk(node)
                    if isinstance(one, ast.Assign)
                    and isinstance(one.value, ast.Call)
                    and ast.unparse(one.value.func) not in ("f32", "np.float32")
                    and isinstance(one.targets[0], ast.Subscript)
                    and isinstance(one.targets[0].slice, ast.Slice)
                }
    assert kernels > 50
    assert found == set()


def test_garbage_is_collected_again_once_a_kernel_is_compiled():
    change_numba()
    with event.trigger_event("numba:compile"):
        with event.trigger_event("numba:compile"):
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_a_formula_becomes_a_kernel_only_where_python_calls_it(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    @threads.scalar
    def twice(value):
        return 2 * value

    @numba.njit
    def four_times(value):
        return twice(twice(value))

    assert four_times(3) == 12
    assert len(twice.inlined.signatures) == 1
    assert not list(tmp_path.rglob("*twice*"))
    assert twice(3) == twice.py_func(3) == 6
    assert list(tmp_path.rglob("*twice*.nbi"))


def test_two_processes_do_not_write_one_file_of_the_kernel_cache(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    threads.kernel(filtering.intensities.py_func)(0, 1, np.ones((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))
    (data,) = tmp_path.rglob("*.nbc")
    assert f".{os.getpid()}." in data.name


def test_what_a_second_process_compiles_are_parts_of_the_system():
    assert {*warmup.SECOND_PROCESS, *warmup.DURING_RUN} <= {name for name, _ in warmup.steps()}


def test_the_second_process_compiles_what_a_run_needs_after_its_first_poses():
    """In a process of its own, since others may have loaded these kernels."""
    program = """
from dudmap.core.backends.cpu import color_pairs, labeling, linear_systems, rectification, segment_motion
from dudmap.lab import warmup
later = color_pairs.linearize_pairs, linear_systems.solve, rectification.rectify, labeling.fit_mixture._alone
later += segment_motion.stand_still, labeling.upsample
assert not any(kernel.signatures for kernel in later)
parts = dict(warmup.steps())
for name in warmup.DURING_RUN:
    parts[name]()
assert all(kernel.signatures for kernel in later), later
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_the_first_demo_waits_for_two_processes(tmp_path, monkeypatch):
    calls = []

    class Process:
        def __init__(self, command, **_):
            assert set(command[3:]) <= {name for name, _ in warmup.steps()}
            self.first = "tracking, labels and map" in command

        def wait(self):
            calls.append(("wait", self.first))

        def terminate(self):
            calls.append(("terminate", self.first))

    monkeypatch.setattr(warmup.subprocess, "Popen", Process)
    monkeypatch.setattr(warmup, "num_threads", lambda: 2)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    with warmup.compiled_for_demo():
        assert calls == [("wait", True), ("wait", False)]
    assert calls[2:] == [("terminate", False), ("wait", False), ("terminate", True), ("wait", True)]
    calls.clear()
    folder = kernel_cache.folder()
    assert folder is not None
    (folder / "kernel.nbi").touch()
    with warmup.compiled_for_demo():
        assert calls == []
