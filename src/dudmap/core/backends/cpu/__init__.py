"""Back-end operations as Numba kernels; the only package that uses Numba and threads.

``backend.py`` divides each operation into bands and owns the buffers.

Kernel arguments have these forms unless a docstring says otherwise:
- ``depth``: (h, w) float32, metres, 0 = none; ``intensity``: (h, w) float32 in [0, 1];
- ``intrinsics``: (4,) float32 fx, fy, cx, cy; ``size``: (2,) int64 image height and width;
- ``block_size``: edge of a block, metres;
- named tuples of parameters: all numbers float32 (``parameters.single``).
"""
