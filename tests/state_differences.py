"""Where two systems differ, attribute by attribute, whatever their classes say that they remember."""

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from functools import cached_property
from types import FunctionType

import numpy as np
from pydantic import BaseModel

from dudmap.core.frames.observation import Level
from dudmap.core.map.block_pager import BlockPager
from dudmap.core.map.block_window import BlockWindow
from dudmap.core.map.fine_blocks import FineBlocks
from dudmap.core.map.voxel_blocks import VoxelBlocks
from dudmap.core.places.frame_store import FrameStore
from dudmap.core.places.place_recognition import KeyframeDatabase
from dudmap.core.state import Stateful, remembered
from dudmap.core.tracking.frame_view import StageTimer


def differences(a, b):
    """Places where two values differ, one a line; empty if they are equal bit for bit, and share the same objects."""
    out = []
    _compare(a, b, "state", out, {})
    return out


def _blocks(blocks):
    slots = blocks.active_slots
    voxels = {"geometry": blocks.geometry[slots], "colors": blocks.colors[slots]}
    return blocks.state() | voxels | {"entries": blocks.num_entries, "slots": blocks.num_slots}


def _level(level):
    slots = level.blocks.active_slots
    return {"blocks": level.blocks, "parents": level.parents[slots], "calm": level.calm[slots]} | {
        "children": np.sort(level.children[level.children >= 0]), "size": level.voxel_size, "finer": level._finer,
    }  # fmt: skip


def _window(window):
    cells = None if window.origin is None else window.cells
    return vars(window) | window.state() | {"mirror": None, "stamps": None, "cells": cells}


def _pager(pager):
    return pager.state() | {"limit": pager.max_blocks, "content": [pager.records(key) for key in pager.away()]}


def _store(store):
    own = {name: value for name, value in vars(store).items() if name not in store.state()}
    threads = ("_encoder", "_file", "_pending", "archived", "_first_own")
    return (own | dict.fromkeys(threads)) | store.state() | {"content": [store.encoded(n) for n in store.kept]}


def _keyframes(database):
    database.settle()
    return vars(database) | {"_sift": None, "_unsettled": None}


VIEWS = {
    VoxelBlocks: _blocks,
    FineBlocks: _level,
    BlockWindow: _window,
    BlockPager: _pager,
    FrameStore: _store,
    KeyframeDatabase: _keyframes,
    StageTimer: lambda timer: {},
    Level: lambda level: {name: getattr(level, name) for name in ("camera", "depth", "intensity")},
}
"""What is compared of objects that hold more: spare room, threads, files, and what is of one process."""
BACKENDS = {"CpuBackend", "WarpBackend"}
PROCESS = {
    "map_id", "_executor", "timings", "_detector", "_halvings", "_recorded_halvings", "_since", "_finding", "pass_ms",
}  # fmt: skip
"""Names of attributes that are of one process, or follow from others."""


def _content(value):
    for cls, view in VIEWS.items():
        if isinstance(value, cls):
            return view(value)
    cls, own = type(value), dict(vars(value))
    if isinstance(value, Stateful):
        own |= {name: getattr(value, name) for name in remembered(cls)}  # also those with the value of the class
    return {
        name: one
        for name, one in own.items()
        if name not in PROCESS and not isinstance(getattr(cls, name, None), cached_property)
    }


def _compare(a, b, place, out, known):
    if isinstance(a, (bool, int, float, str, bytes, type(None), np.generic)):
        if type(a) is not type(b) or not (a == b or (a != a and b != b)):
            out.append(f"{place}: {a!r} and {b!r}"[:200])
    elif isinstance(a, np.ndarray):
        if not (isinstance(b, np.ndarray) and _same(a, b)):
            out.append(place)
    elif isinstance(a, BaseModel | np.random.Generator | np.random.BitGenerator):
        states = (one.bit_generator.state if isinstance(one, np.random.Generator) else one for one in (a, b))
        if len({repr(state) for state in states}) > 1:
            out.append(place)
    elif isinstance(a, Future):
        _compare(a.result(), b.result(), place, out, known)
    elif callable(a) and not hasattr(a, "process") and (isinstance(a, FunctionType) or not vars(type(a)).get("state")):
        if place.endswith("segmentation"):
            _compare(a(), b(), place, out, known)
    elif id(a) in known and not _is_frozen(a):
        if known[id(a)][1] is not b:
            out.append(f"{place} is shared on one side only")
    elif id(a) not in known or known[id(a)][1] is not b:
        known[id(a)] = a, b
        _compare_contents(a, b, place, out, known)


def _is_frozen(value):
    """Whether it is no matter how many there are of it, since none changes."""
    parameters = getattr(value, "__dataclass_params__", None)
    return isinstance(value, tuple) or (parameters is not None and parameters.frozen)


def _compare_contents(a, b, place, out, known):
    if {type(a).__name__, type(b).__name__} <= BACKENDS:
        return
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        _compare_named(dict(a), dict(b), place, out, known)
    elif isinstance(a, list | tuple | deque) and isinstance(b, list | tuple | deque) and len(a) == len(b):
        if isinstance(a, deque) and a.maxlen != b.maxlen:
            out.append(f"{place}.maxlen")
        for n, (one, two) in enumerate(zip(a, b, strict=True)):
            _compare(one, two, f"{place}[{n}]", out, known)
    elif isinstance(a, set | frozenset):
        if a != b:
            out.append(place)
    elif hasattr(a, "__dict__") and (type(a) is type(b) or (isinstance(a, Level) and isinstance(b, Level))):
        _compare_named(_content(a), _content(b), place, out, known)
    elif hasattr(a, "__dict__") or type(a) is not type(b) or a != b:
        out.append(f"{place}: {a!r} and {b!r}"[:200])


def _compare_named(a, b, place, out, known):
    for name in a.keys() | b.keys():
        if name not in a or name not in b:
            out.append(f"{place}.{name} is on one side only")
        else:
            _compare(a[name], b[name], f"{place}.{name}", out, known)


def _same(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
