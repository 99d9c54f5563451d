"""Where the compiled kernels are kept, and whether there are any."""

import os
from pathlib import Path

COMPILING = "compiling the kernels (once, about a minute; dudmap warmup does it in advance)"
"""What is said before a first frame where none is compiled."""


def kernel_cache() -> Path:
    """Folder in which Numba keeps the compiled kernels, as far as it can be known without compiling."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    return Path(given) if given else Path(__file__).parents[1] / "core" / "backends" / "cpu" / "__pycache__"


def compiled_kernels() -> int:
    """Number of kernels in the cache; 0 where there is no cache yet."""
    return sum(1 for _ in kernel_cache().rglob("*.nbi"))
