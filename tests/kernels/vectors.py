"""Counts packed instructions in the code generated for kernels; run as a program so that the settings of numba's
compiler (NUMBA_CPU_NAME, NUMBA_LOOP_VECTORIZE) can differ from those of the tests' own process.

Reads a pickle ``[(module, name, signature, source), ...]`` from stdin, compiles each kernel anew (code that comes from
numba's cache cannot be inspected) and prints a JSON object ``{name: {"loops": .., "packed": .., ...}}``. ``source``
None means the kernel as it is.
"""

import importlib
import json
import pickle
import re
import sys

WIDE = r"\S*\s.*%[yz]mm"
"""Operands in registers of eight or more floats."""
PATTERNS = {
    "fma": rf"\bvfn?m(?:add|sub)\d+ps{WIDE}",
    "packed": rf"\bv(?:add|sub|mul|div|min|max|fn?m(?:add|sub)\d+)ps{WIDE}",
    "converted": rf"\bvcvt(?:dq2ps|tps2dq){WIDE}",
    "scalar": r"\bv(?:add|sub|mul|div|min|max|fn?m(?:add|sub)\d+)ss\b",
}


def counts(kernel, signature, source=None):
    """Vectorised loops, and packed and scalar instructions, of a kernel compiled for one signature."""
    from numba import njit

    function = kernel.py_func
    if source is not None:
        namespace = dict(function.__globals__) | {"kernel": lambda plain: plain, "scalar": lambda plain: plain}
        exec(compile(source, "<variant>", "exec"), namespace)
        function = namespace[function.__name__]
    given = getattr(kernel, "inlined", kernel).targetoptions
    options = {name: value for name, value in given.items() if name in ("nogil", "fastmath", "error_model")}
    compiled = njit(**options)(function)
    compiled.compile(signature)
    (assembly,) = compiled.inspect_asm().values()
    (optimised,) = compiled.inspect_llvm().values()
    found = {name: len(re.findall(pattern, assembly)) for name, pattern in PATTERNS.items()}
    return found | {"loops": len(re.findall(r"^vector\.body\d*:", optimised, re.MULTILINE))}


if __name__ == "__main__":
    wanted = pickle.load(sys.stdin.buffer)
    print(
        json.dumps(
            {
                name: counts(getattr(importlib.import_module(module), name), signature, source)
                for module, name, signature, source in wanted
            }
        )
    )
