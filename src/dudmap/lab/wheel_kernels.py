"""Compiles the kernels of a wheel: ``python -m dudmap.lab.wheel_kernels FOLDER`` (``make package``).

The first process runs every part on small images, for the lowest level, and notes argument types. The others compile
the same kernels for other levels without running them.
"""

import hashlib
import logging
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from dudmap.app.terminal import say
from dudmap.atomic_file import write_bytes
from dudmap.core import shipped_kernels

SHIPPED = "x86-64-v3", "x86-64-v4"


def kernels() -> Iterator[tuple[str, str, Dispatcher]]:
    """Module, name and dispatcher of all called kernels."""
    found = set[int]()
    for module in [name for name in sys.modules if name.startswith("dudmap.")]:
        for name, value in vars(sys.modules[module]).items():
            kernel = vars(value).get("_alone", value) if hasattr(value, "inlined") else value
            if isinstance(kernel, Dispatcher) and kernel.overloads and id(kernel) not in found:
                found.add(id(kernel))
                yield module, name, kernel


def export(kernel: Dispatcher, folder: Path) -> None:
    """Write the compiled forms of a kernel into a folder of the wheel."""
    for sig, form in kernel.overloads.items():
        # the annotation is the source with its place on this machine
        content = dumps(form._replace(type_annotation="")._reduce())
        write_bytes(folder / shipped_kernels.file_name(kernel, sig), hashlib.sha256(content).digest() + content)


def compile_level(noted: Path, folder: Path) -> None:
    """Compile all kernels for Numba's processor, and write them into a folder.

    ``noted``: file of argument types, written by the first process.
    """
    if noted.exists():
        for module, name, signatures in pickle.loads(noted.read_bytes()):
            value = getattr(import_module(module), name)
            for signature in signatures:
                getattr(value, "_alone", value).compile(signature)
    else:
        from dudmap.lab.warmup import steps

        for _, step in steps():
            step()
        write_bytes(noted, dumps([(module, name, list(kernel.overloads)) for module, name, kernel in kernels()]))
    for _, _, kernel in kernels():
        export(kernel, folder)


def main(out: Path) -> None:
    """Compile for each level in a separate process."""
    with tempfile.TemporaryDirectory() as temporary:
        for level in SHIPPED:
            folder = out / shipped_kernels.VERSIONS / level
            folder.mkdir(parents=True)
            environment = os.environ | {
                "NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_INTEL_SVML": "1",
                "NUMBA_CACHE_DIR": temporary,
            }  # fmt: skip
            command = [sys.executable, "-m", "dudmap.lab.wheel_kernels", str(Path(temporary) / "noted"), str(folder)]
            subprocess.run(command, env=environment, check=True)
            sizes = [path.stat().st_size for path in folder.iterdir()]
            say(f"{level}: {len(sizes)} kernels, {sum(sizes) / 1e6:.1f} MB")


if __name__ == "__main__":
    logging.disable()  # the images of the steps are no recording of a camera
    first, *more = map(Path, sys.argv[1:])
    if more:
        compile_level(first, *more)
    else:
        main(first)
