"""Scalar mathematics of pixels, voxels and residuals, which every back end compiles."""
