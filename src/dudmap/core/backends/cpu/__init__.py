"""Back-end operations as Numba kernels; the only package that uses Numba and threads.

``backend.py`` divides each operation into bands and owns the buffers.
"""
