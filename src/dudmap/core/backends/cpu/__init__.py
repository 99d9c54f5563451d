"""The operations of a back end as Numba kernels; the only place that knows Numba and threads.

``backend.py`` cuts each operation into bands and owns the buffers. Numba's cache notices a change of the file that
holds a kernel, but not of the functions it calls: after editing one of those, remove the caches
(``find src -name '*.nb[ic]' -delete``).
"""
