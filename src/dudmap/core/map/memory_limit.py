"""Map blocks that fit into the memory limit of the process."""

import ctypes
import sys
from dataclasses import dataclass
from pathlib import Path

from dudmap.core.map.fine_blocks import BlockTree
from dudmap.errors import ConfigError

SAFE_SHARE = 0.75
"""Share of the limit for maps; temporary data, such as meshes, take the rest."""
LEAST = 400_000_000
"""Bytes for kernels, frames and the map in view."""
_STATM = Path("/proc/self/statm")


@dataclass(frozen=True)
class MemoryLimit:
    """Memory limit of the process, shared by all its maps: ``limit`` bytes of resident memory, measured each time.

    Raises:
        ConfigError: The limit leaves no room for a map, or the memory cannot be read on this platform.
    """

    limit: int

    def __post_init__(self) -> None:
        taken = resident_bytes()
        if self.limit < taken + LEAST:
            raise ConfigError(
                f"found a memory limit of {self.limit / 1e6:.0f} MB; the program takes {taken / 1e6:.0f} MB before the "
                f"first frame, so that at least {(taken + LEAST) / 1e6:.0f} MB are needed"
            )

    def __call__(self, tree: BlockTree) -> int:
        """Blocks with voxels, of all levels, that a map may have in memory now."""
        spare = SAFE_SHARE * self.limit - resident_bytes()
        if spare < 0 and _return_freed():
            spare = SAFE_SHARE * self.limit - resident_bytes()
        # released slots are resident too; the links of a finer block are one percent and neglected
        return tree.num_slots + int(spare / tree.blocks.slot_bytes)


def resident_bytes() -> int:
    """Resident memory, bytes; its maximum on platforms that report only this.

    Raises:
        ConfigError: It cannot be read on this platform.
    """
    try:
        import resource
    except ImportError as error:
        raise ConfigError("the memory of the process cannot be read on Windows; run without a memory limit") from error
    if _STATM.exists():
        return int(_STATM.read_text(encoding="ascii").split()[1]) * resource.getpagesize()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _return_freed() -> bool:
    if sys.platform != "linux":
        return False
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc only
    return trim is not None and bool(trim(0))
