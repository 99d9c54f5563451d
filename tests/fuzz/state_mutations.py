"""Databases of a run whose tree is another one, with the right checksum."""

import copy
import json
import sqlite3
import zlib
from contextlib import closing
from functools import lru_cache

TEXTS = "dudmap.core.slam:Slam", "subprocess:Popen", "os:system", "builtins:eval", "<f8", "|O", "{}", "{", 7
VALUES = (
    None, True, -1, 0, 1, 7, 10**9, 10**40, 1.5, float("nan"), "", "x" * 50, [], {}, [[]], [None] * 40, {"a": 1},
    {"same": 0}, {"same": 3}, {"same": 10**6}, {"same": "x"}, {"array": 0, "id": 90}, {"array": 999, "id": 91},
    {"array": -1, "id": 92}, {"items": [1, {"same": 93}], "id": 93}, {"items": {"stack": 0}, "id": 94},
    {"items": {"lines": 0}, "id": 95}, {"keys": [1], "items": [], "id": 96}, {"stack": 0}, {"stack": 1}, {"lines": 1},
    {"items": [1, 2], "limit": 10**30, "id": 97}, {"items": [1], "limit": "x", "id": 98},
    {"scalar": "<U999999999", "value": "a"}, {"scalar": "|O", "value": 1}, {"scalar": "<f8", "value": "1"},
    {"scalar": "nonsense", "value": 1}, {"random": {"bit_generator": "MT19937"}, "id": 99}, {"random": 3, "id": 100},
    {"result": 3, "id": 103}, {"fields": {}, "id": 104}, {"fields": {"T_world_camera": 3}, "id": 105},
    {"columns": {"timestamp": [1.0]}, "first": 1}, {"json": "{", "id": 107}, {"state": {}, "id": 108},
    {"map": 0, "settings": 3, "state": {}, "id": 109}, {"store": 3, "state": {}, "id": 110},
)  # fmt: skip


@lru_cache(maxsize=2)
def state_parts(data):
    """What the table ``state`` of a database describes, as JSON; None if it cannot be read."""
    with closing(sqlite3.connect(":memory:")) as database:
        try:
            database.deserialize(data[:18] + b"\1\1" + data[20:])  # not in WAL mode, which needs files
            return zlib.decompress(database.execute("SELECT tree FROM state").fetchone()[0]).decode()
        except (sqlite3.Error, zlib.error, TypeError, UnicodeDecodeError):
            return None


def state_tree(rng, data):
    """A database whose tree is another one: other types, references, counts, cycles and attributes."""
    text = state_parts(data)
    if text is None:
        return data
    tree = json.loads(text)
    for _ in range(rng.choice((1, 1, 2, 5))):
        change_node(rng, tree)
    packed = zlib.compress(json.dumps(tree).encode(), 1)
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(data[:18] + b"\1\1" + data[20:])
        database.execute("UPDATE state SET crc = ?, tree = ?", (zlib.crc32(packed), packed))
        database.commit()
        out = database.serialize()
    return out[:18] + b"\2\2" + out[20:]


def change_node(rng, tree):
    """Change one place of a tree; places near the root as often as deep ones."""
    node, above = tree, []
    for _ in range(rng.randrange(1, 14)):
        above.append(node)
        keys = list(node) if isinstance(node, dict) else range(len(node))
        if not keys:
            break
        key = rng.choice(keys)
        if not isinstance(node[key], dict | list):
            break
        node = node[key]
    node = above[-1]
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    if not keys:
        return
    key, change = rng.choice(keys), rng.random()
    if change < 0.5:
        node[key] = copy.deepcopy(rng.choice(VALUES))
    elif change < 0.6:
        del node[key]
    elif change < 0.7:
        other = rng.choice(keys)
        node[key], node[other] = node[other], node[key]
    elif change < 0.8 and isinstance(node, dict):
        node[rng.choice(("__class__", "__dict__", "forgotten", "fields", "state", "map", "store"))] = node[key]
    elif change < 0.9:
        node[key] = rng.choice(TEXTS) if isinstance(node[key], str) else copy.deepcopy(rng.choice(above))
    elif isinstance(node, list):
        node.extend(copy.deepcopy(node[:1]) * rng.choice((1, 3, 40)))
    elif isinstance(node[key], int):
        node[key] += rng.choice((-1, 1, 2, 1000))
