"""Compilation of all kernels ahead of time: PTX or machine code for GPUs, without a GPU or a driver."""

from importlib import import_module
from pathlib import Path

import warp as wp  # pyright: ignore[reportMissingImports]

MODULES = tuple(f"dudmap.core.backends.warp.kernels.{name}" for name in ("fusion", "surface", "raycasting", "rows"))
"""Modules that hold kernels."""


def compile_kernels(folder: str | Path, architectures: tuple[int, ...] = (80, 90), ptx: bool = True) -> list[Path]:
    """Compile the kernels of all modules for compute capabilities, 90 for 9.0: to PTX, which a driver compiles for its
    GPU, or machine code (cubin). Returns the files, one per module and architecture."""
    before = set(Path(folder).rglob("*")) if Path(folder).exists() else set()
    for name in MODULES:
        import_module(name)
        wp.compile_aot_module(name, arch=list(architectures), module_dir=str(folder), use_ptx=ptx)
    suffix = ".ptx" if ptx else ".cubin"
    return sorted(path for path in set(Path(folder).rglob("*")) - before if path.suffix == suffix)
