"""Array loops behind the operations of a back end (``backend.py``); the only place that knows Numba and threads.

``pixel.py``, ``voxel.py`` and ``residual.py`` hold the scalar mathematics as plain functions of float32 numbers;
``parameters.py`` the named inputs and results; ``cpu.py`` cuts each operation into bands and owns the buffers. Numba's
cache notices a change of the file that holds a kernel, but not of the functions it calls: after editing one of those,
remove the caches (``find src -name '*.nb[ic]' -delete``).
"""
