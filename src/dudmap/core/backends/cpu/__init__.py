"""The operations of a back end as Numba kernels; the only place that knows Numba and threads.

``backend.py`` cuts each operation into bands and owns the buffers.
"""
