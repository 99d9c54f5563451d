"""Warp kernels: loops over pixels, voxels and blocks around the formulas shared with the CPU (``formulas.py``)."""
