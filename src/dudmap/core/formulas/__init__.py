"""Scalar formulas of pixels, voxels and residuals, compiled by every back end."""
