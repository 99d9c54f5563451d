"""Warp kernels: loops over pixels, voxels and blocks around the formulas that the CPU has, too (``formulas.py``)."""
