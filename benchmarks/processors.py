"""How far results differ between processors: the whole test suite and a few figures, as other processors compute them.

    python benchmarks/processors.py [--only NAME,NAME] [--out DIR] [--figures-only] [-- PYTEST_ARGUMENT ...]

A configuration is a processor of ``PROCESSORS`` and any of ``VARIANTS``, joined by "+", such as ``haswell+ipp-off``;
without --only, all of ``CONFIGURATIONS`` are run. Every library is told by its environment variables which instructions
it may use, so one machine stands in for those that can do less. A processor that this machine cannot stand in for is
left out, and named. Prints tests and failures per configuration, then the least and the greatest of each figure over
the configurations, and the greatest difference between any two. Exit status 1 if a test failed anywhere.

NUMBA_CPU_NAME alone does not take instructions away: Numba then still passes the features of the processor at hand to
LLVM. NUMBA_CPU_FEATURES is therefore set to those that the machine at hand lacks, as negatives, which leaves what the
named processor has and this one can run.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.lab.benchmark.table import grid

ROOT = Path(__file__).resolve().parents[1]
EXCERPT = ROOT / "tests" / "fixtures" / "freiburg1_xyz"


@dataclass(frozen=True)
class Processor:
    """What the libraries use on a processor.

    Attributes:
        needs: Instructions the machine at hand must have, in LLVM's words.
        numpy: NumPy's dispatch targets.
        openblas: Kernel set of the BLAS in NumPy and SciPy.
        opencv: OpenCV's dispatch targets, as ``cv2.getCPUFeaturesLine`` writes them.
        ipp: Code path of the Intel primitives in OpenCV.
    """

    needs: tuple[str, ...]
    numpy: tuple[str, ...]
    openblas: str
    opencv: tuple[str, ...]
    ipp: str


SSE4 = ("SSE4.1", "SSE4.2")
AVX2 = (*SSE4, "AVX", "FP16", "AVX2")
AVX512 = ("avx2", "fma", "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
PROCESSORS = {
    "generic": Processor((), (), "Nehalem", (), "sse42"),
    "haswell": Processor(("avx2", "fma"), ("X86_V3",), "Haswell", AVX2, "avx2"),
    "skylake-avx512": Processor(AVX512, ("X86_V3", "X86_V4"), "SkylakeX", (*AVX2, "AVX512-SKX"), "avx512"),
    "znver4": Processor(
        (*AVX512, "avx512vbmi2", "avx512vnni", "avx512bf16"),
        ("X86_V3", "X86_V4", "AVX512_ICL"), "Cooperlake", (*AVX2, "AVX512-SKX", "AVX512-ICL"), "avx512",
    ),
}  # fmt: skip
"""Beside ``host``, the machine as it is. x86-64 only. OpenBLAS runs its Cooperlake kernels on Zen 4."""
VARIANTS = {
    "ipp-off": {"OPENCV_IPP": "disabled"},
    "unoptimised": {"DUDMAP_OPENCV_OPTIMIZED": "0"},
    "1-thread": {"DUDMAP_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"},
}
"""OpenCV without Intel's primitives; OpenCV after ``cv2.setUseOptimized(False)``, see tests/conftest.py; one thread."""
CONFIGURATIONS = (
    "host",
    "generic",
    "haswell",
    "skylake-avx512",
    "znver4",
    "host+ipp-off",
    "host+unoptimised",
    "host+1-thread",
    "generic+unoptimised+1-thread",
    "haswell+ipp-off+1-thread",
    "skylake-avx512+ipp-off",
    "znver4+ipp-off",
)
FIGURES = {
    "ate_rmse_m": ("ATE RMSE, mm", 1000),
    "rotation_rmse_deg": ("rotation RMSE, deg", 1),
    "mask_iou": ("mask IoU with the truth", 1),
    "lost": ("frames lost", 1),
}
"""Key, heading, factor from the stored unit."""


def missing(configuration: str) -> list[str]:
    """Instructions that the configuration needs and this machine lacks."""
    import llvmlite.binding as llvm

    name = configuration.split("+")[0]
    features = llvm.get_host_cpu_features()
    return [] if name == "host" else [need for need in PROCESSORS[name].needs if not features.get(need)]


def settings(configuration: str) -> dict[str, str]:
    """Environment variables that make a process compute as the configuration does.

    Raises:
        SystemExit: There is no such processor or variant.
    """
    import cv2
    import llvmlite.binding as llvm

    name, *variants = configuration.split("+")
    if name not in ("host", *PROCESSORS) or not set(variants) <= set(VARIANTS):
        raise SystemExit(f"no configuration {configuration}; processors: host, {', '.join(PROCESSORS)}; "
                         f"variants: {', '.join(VARIANTS)}")  # fmt: skip
    out = {"DUDMAP_THREADS": "2", "OPENCV_LOG_LEVEL": "ERROR"}
    if name != "host":
        processor = PROCESSORS[name]
        lacking = [feature for feature, present in llvm.get_host_cpu_features().items() if not present]
        dispatched = [word.strip("*?") for word in cv2.getCPUFeaturesLine().split() if word.startswith("*")]
        usable = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
        out |= {
            "NUMBA_CPU_NAME": name,
            "NUMBA_CPU_FEATURES": ",".join(f"-{feature}" for feature in lacking),
            "NPY_DISABLE_CPU_FEATURES": " ".join(target for target in usable if target not in processor.numpy),
            "OPENBLAS_CORETYPE": processor.openblas,
            "OPENCV_CPU_DISABLE": ",".join(word for word in dispatched if word not in processor.opencv),
            "OPENCV_IPP": processor.ipp,
        }
    for variant in variants:
        out |= VARIANTS[variant]
    return out


def environment(configuration: str, out: Path) -> dict[str, str]:
    """This process's environment with the configuration's settings; compiled kernels are kept per processor."""
    cache = out / "cache" / configuration.split("+")[0]
    return os.environ | settings(configuration) | {"NUMBA_CACHE_DIR": str(cache)}


def run_tests(configuration: str, out: Path, arguments: list[str]) -> tuple[int, dict[str, str]]:
    """Number of tests run, and the first line of each failure by name of the test.

    Tests that inspect the machine code made for the machine at hand (test_vectorised.py) are left out. That pytest
    itself ended before its time counts as a failure.
    """
    report = out / f"{configuration}.xml"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "--numprocesses=auto", "--maxprocesses=4", "--dist=loadfile"]
    command += ["-p", "no:cacheprovider", "--hypothesis-seed=0", "--ignore-glob=*/test_vectorised.py"]
    with (out / f"{configuration}.log").open("w", encoding="utf-8") as log:
        status = subprocess.run(
            [*command, f"--junitxml={report}", *arguments],
            cwd=ROOT, env=environment(configuration, out), stdout=log, stderr=subprocess.STDOUT, check=False,
        ).returncode  # fmt: skip
    if status not in (0, 1) or not report.is_file():
        return 0, {"pytest": f"ended with status {status}; see {log.name}"}
    cases = list(ElementTree.parse(report).iter("testcase"))
    failures = {}
    for case in cases:
        for problem in (*case.findall("failure"), *case.findall("error")):
            failures[f"{case.get('classname')}::{case.get('name')}"] = problem.get("message", "").partition("\n")[0]
    return len(cases), failures


def measure(out: Path) -> None:
    """Run the system, in this process, over three small recordings; poses, masks and figures go to ``out``.npz."""
    import cv2

    from dudmap import Config, Slam, Trajectory, open_sequence
    from dudmap.lab.benchmark.score import score_trajectory
    from dudmap.lab.synthetic import sequence

    if os.environ.get("DUDMAP_OPENCV_OPTIMIZED") == "0":
        cv2.setUseOptimized(False)
    world = sequence(frames=40, situation="people_at_start", camera=sequence().camera.resized(320, 240))
    recordings: dict[str, Any] = {
        "excerpt": (open_sequence(EXCERPT), Config()),
        "excerpt, thesis": (open_sequence(EXCERPT), Config.from_tree({"preset": "thesis"})),
        "room": (world, Config()),
    }
    arrays: dict[str, NDArray[Any]] = {}
    for name, (recording, config) in recordings.items():
        slam = Slam(recording.camera, config)
        results = [slam.process(recording[index]) for index in range(len(recording))]
        tracked = [result for result in results if result.T_world_camera is not None]
        poses = np.array([result.T_world_camera for result in tracked])
        row = score_trajectory(Trajectory(np.array([r.timestamp for r in tracked]), poses), recording.ground_truth)
        row["lost"] = len(results) - len(tracked)
        masks = np.array([result.dynamic_mask for result in results])
        if recording is world:
            row["mask_iou"] = iou(masks, np.array([world.mask(index) for index in range(len(world))]))
        everywhere = np.full((len(results), 4, 4), np.nan)
        everywhere[[result.T_world_camera is not None for result in results]] = poses
        arrays |= {f"{name}/poses": everywhere, f"{name}/masks": masks}
        arrays[f"{name}/figures"] = np.array(json.dumps({key: row[key] for key in FIGURES if key in row}))
    np.savez_compressed(out, allow_pickle=False, **arrays)


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of all pixels of all frames; 1 where both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def differences(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, float]:
    """Greatest distance (m) and angle (deg) between two stacks of poses, (N, 4, 4), in frames tracked by both."""
    both = np.isfinite(a).all((1, 2)) & np.isfinite(b).all((1, 2))
    a, b = a[both], b[both]
    # ||Ra - Rb|| = 2 sqrt(2) sin(angle / 2): well conditioned at small angles, unlike the arc cosine of the trace
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / (2 * np.sqrt(2))
    distance = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    return float(distance.max()), float(np.degrees(2 * np.arcsin(np.clip(chord, 0, 1))).max())


def spread(files: dict[str, Path]) -> str:
    """Least and greatest of each figure with their configurations, and the greatest differences between any two."""
    loaded = {}
    for name, path in files.items():
        with np.load(path) as content:
            loaded[name] = dict(content)
    some = next(iter(loaded.values()))
    figures, between = [], []
    for recording in (key.removesuffix("/figures") for key in some if key.endswith("/figures")):
        rows = {name: json.loads(str(arrays[f"{recording}/figures"])) for name, arrays in loaded.items()}
        for key, (heading, factor) in FIGURES.items():
            values = {name: factor * row[key] for name, row in rows.items() if key in row}
            if values:
                low, high = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
                figures.append([recording, heading, f"{values[low]:.4g}", low, f"{values[high]:.4g}", high])
        pairs = []
        for a, b in combinations(loaded.values(), 2):
            distance, angle = differences(a[f"{recording}/poses"], b[f"{recording}/poses"])
            pairs.append((1000 * distance, angle, iou(a[f"{recording}/masks"], b[f"{recording}/masks"])))
        if pairs:
            distances, angles, ious = zip(*pairs, strict=True)
            between.append([recording, f"{max(distances):.3g}", f"{max(angles):.2g}", f"{min(ious):.4f}"])
    text = grid(["recording", "figure", "least", "with", "greatest", "with"], figures)
    if between:
        header = ["between any two", "position, at most mm", "rotation, at most deg", "IoU of their masks, at least"]
        text += "\n" + grid(header, between)
    return text


def main() -> int:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="comma-separated configurations")
    parser.add_argument("--out", type=Path, default=Path("runs/processors"), help="logs, figures, compiled kernels")
    parser.add_argument("--figures-only", action="store_true", help="leave the tests out")
    parser.add_argument("--measure", type=Path, default=None, help=argparse.SUPPRESS)  # the own process of the figures
    parser.add_argument("pytest", nargs="*", help="arguments for pytest, such as test files")
    arguments = parser.parse_args()
    if arguments.measure is not None:
        measure(arguments.measure)
        return 0

    out = arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    names = [name for name in arguments.only.split(",") if name] or CONFIGURATIONS
    for name in names:
        settings(name)  # a name that is wrong ends the program here
    rows, failed, files = [], {}, {}
    for name in names:
        if lacking := missing(name):
            print(f"{name} is left out: this machine has no {', '.join(lacking)}", flush=True)
            continue
        start = time.perf_counter()
        figures = out / f"{name}.npz"
        command = [sys.executable, __file__, "--measure", str(figures)]
        status = subprocess.run(command, env=environment(name, out), check=False).returncode
        if status == 0:
            files[name] = figures
        else:
            failed.setdefault("figures", {})[name] = f"the program that computes them ended with status {status}"
        if not arguments.figures_only:
            count, failures = run_tests(name, out, arguments.pytest)
            for test, message in failures.items():
                failed.setdefault(test, {})[name] = message
            rows.append([name, str(count), str(len(failures)), f"{(time.perf_counter() - start) / 60:.1f}"])
            print(f"{name}: {len(failures)} of {count} tests failed", flush=True)
    if rows:
        print("\n" + grid(["configuration", "tests", "failed", "minutes"], rows))
    for test, messages in failed.items():
        print(f"\n{test}")
        for name, message in messages.items():
            print(f"    {name}: {message}")
    if files:
        print("\n" + spread(files))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
