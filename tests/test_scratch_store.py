"""The temporary file of byte strings: against a dictionary, and with a disk that is full."""

import sqlite3

import numpy as np
import pytest

from dudmap.core.scratch_store import ScratchStore
from dudmap.errors import MapError


def num_bytes(store):
    return np.prod([store._connection.execute(f"PRAGMA page_{of}").fetchone()[0] for of in ("count", "size")])


def test_room_of_removed_keys_is_used_again():
    """Against a dictionary, with parts of random sizes; the file ends up with little more than what is stored."""
    rng, store, known = np.random.default_rng(0), ScratchStore("frames"), {}
    for n in range(3000):
        known[str(n)] = [rng.bytes(size) for size in rng.integers(0, 12000, 3)]
        store.write(str(n), known[str(n)])
        if len(known) > 50:
            key = str(rng.choice(list(known)))
            del known[key]
            store.remove(key)
        if n % 100 == 0:
            assert all(store.read(key) == parts for key, parts in known.items())
    assert num_bytes(store) < 2 * sum(len(part) for parts in known.values() for part in parts)
    with pytest.raises(MapError, match="frames: gone is missing"):
        store.read("gone")


def test_a_key_is_written_anew_or_stays_as_it_was():
    store = ScratchStore("frames")
    store.write("a", [b"1", b"2"])
    store.write("a", [b"3"])
    assert store.read("a") == [b"3"]
    store._connection.execute("PRAGMA max_page_count = 10")
    with pytest.raises(MapError, match=r"frames cannot be stored in .*full; make room there.*TMPDIR"):
        store.write("a", [bytes(100_000)])
    assert store.read("a") == [b"3"]
    store.close()
    with pytest.raises(sqlite3.ProgrammingError):
        store._connection.execute("SELECT 1")
