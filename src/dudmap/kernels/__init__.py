"""Array loops: the only place that knows numba."""
