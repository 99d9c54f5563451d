"""Where two stored states of systems differ, for the tests that continue them."""

import numpy as np


def differences(a, b):
    """Where two snapshots of whole systems differ, one place a line; empty if they are equal bit for bit."""
    out = []
    _compare(a.tree, b.tree, a, b, "state", out)
    for one, two in zip(a.maps, b.maps, strict=True):
        if not (np.array_equal(one.slots, two.slots) and np.array_equal(one.voxels, two.voxels)):
            out.append(f"voxels of map {one.number}")
    for one, two in zip(a.frames, b.frames, strict=True):
        if one.frames != two.frames:
            out.append(f"stored frames {one.number}")
    return out


_ARRAYS = "array", "numbers", "stack"


def _compare(a, b, one, two, place, out):
    if isinstance(a, dict) and isinstance(b, dict):
        for key in a.keys() | b.keys():
            where = f"{place}.{key}" if key not in ("attributes", "values", "list", "tuple") else place
            if key not in a or key not in b:
                out.append(f"{where} is on one side only")
            elif key in _ARRAYS and isinstance(a[key], int) and isinstance(b[key], int):
                if not _same(one.arrays[a[key]], two.arrays[b[key]]):
                    out.append(where)
            elif key == "records":
                if one.arrays[a[key]] != two.arrays[b[key]]:
                    out.append(where)
            else:
                _compare(a[key], b[key], one, two, where, out)
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for n, (left, right) in enumerate(zip(a, b, strict=True)):
            _compare(left, right, one, two, f"{place}[{n}]", out)
    elif a != b and not (a != a and b != b):  # two NaN are equal
        out.append(f"{place}: {a!r} and {b!r}"[:200])


def _same(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
