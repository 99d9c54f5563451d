"""Numba loops of the synthetic renderer."""
