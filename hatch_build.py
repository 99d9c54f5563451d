"""Adds the compiled kernels in the folder DUDMAP_KERNELS to a wheel, which then is for this Python and Linux only."""

import os
import sys
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledKernels(BuildHookInterface):
    """Hook of hatchling, which builds the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Name the folder and the tag; the kernels call nothing but libc and libm, of any glibc that Numba runs on."""
        folder = os.environ.get("DUDMAP_KERNELS")
        if folder and version == "standard":
            build_data["force_include"][os.path.abspath(folder)] = "dudmap/core/compiled"
            build_data["pure_python"] = False
            build_data["tag"] = f"cp{sys.version_info[0]}{sys.version_info[1]}-none-manylinux_2_17_x86_64"
