"""Dense systems of equations against NumPy's solver."""

import numpy as np
import pytest

from dudmap.core.backends.cpu.linear_systems import solved


@pytest.mark.parametrize("columns", [(), (13,)])
def test_solution_is_that_of_numpy(columns):
    rng = np.random.default_rng(0)
    J = rng.normal(size=(90, 61))
    H, right = J.T @ J + np.eye(61), rng.normal(size=(61, *columns))
    given = H.copy(), right.copy()
    assert np.allclose(solved(H, right), np.linalg.solve(H, right), rtol=1e-9, atol=1e-12)
    assert np.array_equal(H, given[0])
    assert np.array_equal(right, given[1])
