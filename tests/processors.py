"""How far results differ between processors: all tests and the figures of the gate, as other processors compute them.

    python tests/processors.py [--only NAME,NAME] [--out DIR] [--figures-only] [-- PYTEST_ARGUMENT ...]

A configuration is a processor of ``PROCESSORS`` and any of ``VARIANTS``, joined by "+", such as ``haswell+ipp-off``;
without --only, all of ``CONFIGURATIONS`` are run. Every library is told by its environment variables which instructions
it may use, so one machine stands in for those that can do less. A processor that this machine cannot stand in for is
left out, and named. Prints tests and failures per configuration, then the least and the greatest of each figure of the
accuracy gate over the configurations. Exit status 1 if a test failed anywhere.

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
from pathlib import Path

import numpy as np

from dudmap.evaluation.tables import grid

ROOT = Path(__file__).resolve().parents[1]


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


def figures_of(configuration: str, out: Path) -> dict[tuple[str, str], float]:
    """Figures of the accuracy gate (``dudmap benchmark gate``), by recording and figure."""
    command = [sys.executable, "-m", "dudmap", "benchmark", "gate", "--json"]
    done = subprocess.run(
        command, cwd=ROOT, env=environment(configuration, out), stdout=subprocess.PIPE, text=True, check=False
    )
    checks = json.loads(done.stdout or "{}").get("checks", [])
    return {(row["sequence"], row["figure"]): row["measured"] for row in checks if row["measured"] is not None}


def spread(figures: dict[str, dict[tuple[str, str], float]]) -> str:
    """Least and greatest of each figure with their configurations."""
    lines = []
    for sequence, figure in next(iter(figures.values())):
        values = {name: found[sequence, figure] for name, found in figures.items() if (sequence, figure) in found}
        low, high = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
        lines.append([sequence, figure, f"{values[low]:.4g}", low, f"{values[high]:.4g}", high])
    return grid(["recording", "figure", "least", "with", "greatest", "with"], lines)


def main() -> int:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="comma-separated configurations")
    parser.add_argument("--out", type=Path, default=Path("runs/processors"), help="logs, figures, compiled kernels")
    parser.add_argument("--figures-only", action="store_true", help="leave the tests out")
    parser.add_argument("pytest", nargs="*", help="arguments for pytest, such as test files")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    names = [name for name in arguments.only.split(",") if name] or CONFIGURATIONS
    for name in names:
        settings(name)  # a name that is wrong ends the program here
    rows, failed, figures = [], {}, {}
    for name in names:
        if lacking := missing(name):
            print(f"{name} is left out: this machine has no {', '.join(lacking)}", flush=True)
            continue
        start = time.perf_counter()
        figures[name] = figures_of(name, out)
        if not figures[name]:
            failed.setdefault("figures", {})[name] = "the program that computes them failed"
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
    if all(figures.values()):
        print("\n" + spread(figures))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
