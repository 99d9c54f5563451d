"""Copies of a caller's arrays."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from dudmap.errors import DatasetError


def copied(
    values: object, what: str, dtype: DTypeLike | None = np.float64, shape: tuple[int, ...] | None = None
) -> NDArray[Any]:
    """Copy of an array or array-like object.

    Args:
        what: Name in messages.
        dtype: Type of the copy; None keeps the type.
        shape: Required shape; None allows all.

    Raises:
        DatasetError: ``values`` is no array of numbers, or has another shape.
    """
    try:
        out = np.array(values, dtype=dtype, order="C")
    except (TypeError, ValueError):
        out = np.array(None)
    if out.dtype.kind not in "biuf" or values is None or (shape is not None and out.shape != shape):
        found = f"the shape {values.shape}" if isinstance(values, np.ndarray) else f"a {type(values).__name__}"
        expected = "an array of numbers" if shape is None else f"numbers of the shape {shape}"
        raise DatasetError(f"{what}: found {found}; expected {expected}")
    return out
