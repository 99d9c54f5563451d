"""The hot loops are compiled to packed instructions; that breaks silently, and costs a factor of three to five.

LLVM vectorises a loop only as long as its body has neither a branch around a load nor an index it cannot bound. What
is asked of each kernel is about two thirds of what the code holds today, for AVX2 (three-stage loops need no more) and
for the machine at hand.
"""

import inspect
import json
import os
import pickle
import platform
import re
import subprocess
import sys

import numpy as np
import pytest
import vectors
from numba import njit
from vectors import counts

from dudmap.config import Config, SensorConfig
from dudmap.core.backends.cpu import (
    color_pairs,
    evidence,
    filtering,
    fusion,
    integration,
    labeling,
    registration,
    sampling,
)
from dudmap.core.calibration.adjustment import Adjustment, Fit, Pair, PairSet
from dudmap.core.calibration.keyframes import KeyframeCollector
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.slam import Slam
from dudmap.lab.synthetic import sequence
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA

pytestmark = pytest.mark.slow
PAIRS = color_pairs, "linearize_pairs"
FEWEST = {
    (registration, "linearize_rows"): {"loops": 2, "fma": 66, "packed": 180, "converted": 18},
    PAIRS: {"loops": 1, "fma": 268, "packed": 480},
    (sampling, "sample_rows"): {"loops": 2, "fma": 8, "packed": 15, "converted": 10},
    (integration, "integrate_blocks"): {"loops": 5, "fma": 9, "packed": 48, "converted": 16},
    (integration, "pack_pixels"): {"loops": 2, "packed": 9},
    (labeling, "upsample_rows"): {"loops": 1, "packed": 3},
    (labeling, "mean_field"): {"loops": 1},
    (filtering, "bilateral"): {"loops": 2, "fma": 3, "packed": 28},
    (filtering, "fill_holes"): {"loops": 2, "packed": 12},
    (filtering, "limit_depth"): {"loops": 1},
    (filtering, "pad"): {"loops": 1},
    (filtering, "intensities"): {"loops": 1, "fma": 2, "packed": 3, "converted": 2},
    (filtering, "halve_intensity"): {"loops": 1, "packed": 3},
    (filtering, "halve_depth"): {"loops": 1, "fma": 3, "packed": 6},
}
"""Least number of vectorised loops and of packed instructions on eight or more floats, per kernel."""
CALLERS = registration.descend, fusion.fuse, sampling.sample, evidence.moving_pixels, labeling.upsample
"""Kernels that some of these are inlined into."""
LONGEST = [(registration, "linearize_rows"), (integration, "integrate_blocks")]
"""Kernels of which one scalar loop is enough to be caught; they take half of the compiler's time."""


@pytest.fixture(scope="module")
def signatures():
    """The types that the system calls its kernels with: of a tiny recording run through it."""
    import llvmlite.binding as llvm

    if platform.machine().lower() not in ("x86_64", "amd64"):
        pytest.skip(f"the expected instructions are those of x86-64; this is {platform.machine()}")
    features = llvm.get_host_cpu_features()
    if not (features.get("avx2") and features.get("fma")):
        pytest.skip("this processor has no AVX2 with fused multiply-add")
    camera = DEFAULT_CAMERA.resized(160, 120)
    recording = sequence(frames=3, camera=camera)
    slam = Slam(camera, Config().override(["volume.voxel_size=0.04", "preprocess.depth_max=4"]))
    given = Calibration.registered(camera)
    collector, still = KeyframeCollector(given), np.zeros(camera.shape, bool)
    for index in range(3):
        assert slam.process(recording[index]).dynamic_mask is not None  # upsamples the labels
        collector.add(slam.preprocess(recording[index]), np.eye(4), still)
    pairs = PairSet([Pair(collector.keyframes[0], collector.keyframes[0])])
    Adjustment(given, SensorConfig()).with_poses(pairs, Fit.tracked(pairs, given))
    for caller in CALLERS:  # one that comes from the cache does not say what it calls its own functions with
        njit(nogil=True, error_model="numpy")(caller.py_func).compile(caller.signatures[0])
    kernels = {name: getattr(module, name) for module, name in FEWEST}
    return {name: getattr(kernel, "inlined", kernel).signatures[0] for name, kernel in kernels.items()}


def compiled(signatures, sources, **settings):
    """Counts per kernel, compiled anew for this processor, or by a process with other settings of numba's compiler.

    ``sources`` are the kernels with their variants, None as they are. What they call may come from the cache.
    """
    wanted = [(module, name, signatures[name], sources[name]) for module, name in FEWEST if name in sources]
    if not settings:
        return {name: counts(getattr(module, name), *rest) for module, name, *rest in wanted}
    done = subprocess.run(
        [sys.executable, vectors.__file__],
        input=pickle.dumps([(module.__name__, *rest) for module, *rest in wanted]),
        capture_output=True,
        env=os.environ | settings,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def scalar_loops(found):
    """A sentence per kernel and kind of instruction that there is too little of."""
    return [
        f"{name} has {found[name][kind]} {kind}, expected {least} or more: {found[name]}"
        for _, name in FEWEST
        if name in found
        for kind, least in FEWEST[_, name].items()
        if found[name][kind] < least
    ]


@pytest.mark.parametrize("processor", ["native", "haswell"])
def test_hot_loops_are_vectorised(signatures, processor):
    """``haswell`` is AVX2 without AVX-512: what most desktops have."""
    settings = {} if processor == "native" else {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": "+avx2,+fma"}
    assert scalar_loops(compiled(signatures, {name: None for _, name in FEWEST}, **settings)) == []


def test_kernels_without_vectorisation_are_caught(signatures, tmp_path):
    shorter = {name: None for module, name in FEWEST if (module, name) not in (*LONGEST, PAIRS)}
    # numba's cache tells processors apart, but not this setting
    caught = scalar_loops(compiled(signatures, shorter, NUMBA_LOOP_VECTORIZE="0", NUMBA_CACHE_DIR=str(tmp_path)))
    assert {sentence.split()[0] for sentence in caught} == shorter.keys()


@pytest.mark.parametrize("module_name", LONGEST)
def test_one_scalar_loop_is_caught(signatures, module_name):
    """A way out of the longest loop, the heart of these kernels, is all it takes."""
    module, name = module_name
    source = inspect.getsource(getattr(module, name).py_func).replace("@scalar\n", "")
    loops = re.finditer(r"^( +)for (\w+) in range\((?:w|512)\):\n((?:\1 +.*\n)+)", source, re.MULTILINE)
    heart = max(loops, key=lambda loop: len(loop[3]))
    indent, index = heart[1], heart[2]
    way_out = f"{indent}    if T[{index} % 3, {index} % 4] > 1e30:\n{indent}        break\n"
    variant = source[: heart.start(3)] + way_out + source[heart.start(3) :]
    caught = scalar_loops(compiled(signatures, {name: variant}))
    assert any(" loops" in sentence for sentence in caught), caught
    if name == "linearize_rows":  # of the other, the compiler for some processors packs what is left nevertheless
        assert any(" packed" in sentence for sentence in caught), caught
