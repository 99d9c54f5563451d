"""A database of a run from elsewhere is data: it runs nothing, and is bounded in memory and time."""

import json
import os
import re
import signal
import sqlite3
import threading
import time
import zlib
from contextlib import closing

import numpy as np
import pytest

from dudmap.app.state import database, schema
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import restore, take_snapshot
from dudmap.errors import StateError

ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS key, 'a' AS value FROM n"


@pytest.fixture
def path(tmp_path):
    made = StateDatabase(tmp_path / "state.db")
    made.write(take_snapshot({"numbers": np.arange(100.0)}, made), {"next": 1})
    made.close()
    return tmp_path / "state.db"


def change(path, *statements):
    with closing(sqlite3.connect(path)) as connection, connection:
        for statement in statements:
            connection.execute(statement)


@pytest.mark.parametrize("statements", [
    ("DROP TABLE meta", f"CREATE VIEW meta AS {ENDLESS}"),
    ("CREATE TRIGGER t AFTER INSERT ON meta BEGIN DELETE FROM blocks; END",),
    ("CREATE INDEX i ON meta (abs(value))",),
    ("CREATE TABLE more (a)",),
    ("DROP TABLE frames",),
    ("DROP TABLE state", "CREATE TABLE state (id, crc, tree GENERATED ALWAYS AS (zeroblob(1000000000)))"),
    ("DROP TABLE meta", "CREATE VIRTUAL TABLE meta USING fts5(key, value)"),
])  # fmt: skip
def test_a_database_with_other_tables_is_not_read(statements, path):
    try:
        change(path, *statements)
    except sqlite3.OperationalError as error:
        if "no such module" not in str(error):
            raise
        pytest.skip(str(error))
    with pytest.raises(StateError, match="damaged or not of this program: its tables are not those of a state"):
        StateReader(path)


@pytest.fixture
def ctrl_c():
    """Python's own answer to ctrl-C, whatever a library or the test runner has made of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_and_a_limit_end_an_endless_query(path, monkeypatch, ctrl_c):
    reader = StateReader(path)
    timer = threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(reader._rows(f"SELECT count(*) FROM ({ENDLESS})"))
    assert time.monotonic() - start < 5
    timer.join()
    monkeypatch.setattr(database, "LIMIT", 100)
    with pytest.raises(StateError, match="is damaged: interrupted"):
        list(reader._rows(f"SELECT count(*) FROM ({ENDLESS})"))
    assert reader.meta() == {"next": 1}


def test_a_tree_that_is_a_bomb(path):
    packed = zlib.compress(bytes(2**28), 1)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE state SET crc = ?, tree = ?", (zlib.crc32(packed), packed))
    with pytest.raises(StateError, match="unpack to more than"):
        restore(StateReader(path), {})


def test_a_journal_is_not_played_back(path, tmp_path):
    """A rollback journal may name another file, which SQLite deletes afterwards."""
    path.with_name("state.db-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(1000))
    with pytest.raises(StateError, match=r"there is a state\.db-journal beside .*; remove it"):
        StateReader(path)


@pytest.mark.skipif(os.name != "posix", reason="sparse files")
def test_a_file_of_holes(path):
    with path.open("ab") as file:
        file.truncate(2**40)
    with pytest.raises(StateError, match="bytes are there"):
        StateReader(path)


def test_a_row_that_is_larger_than_memory(path):
    change(path, "UPDATE meta SET value = zeroblob(400000000)")
    with pytest.raises(StateError, match="is damaged"):
        StateReader(path).meta()


def store(path, tree, arrays=()):
    """Replace the tree of a database."""
    packed = zlib.compress(json.dumps({"tree": tree, "arrays": list(arrays)}).encode())
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE state SET crc = ?, tree = ?", (zlib.crc32(packed), packed))


CALLED = {"tuple": [10**9], "class": "dudmap.core.map.voxel_blocks:VoxelBlocks", "id": 1}
LIST = {"list": [1, 2], "id": 1}


def camera(**changes):
    values = {"fx": 30.0, "fy": 30.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30, "depth_scale": 1000.0,
              "distortion": {"tuple": [], "id": 2}} | changes  # fmt: skip
    attributes = {key: value for key, value in values.items() if value != "left out"}
    return {"object": "dudmap.core.geometry.camera:Camera", "id": 1, "attributes": attributes}


@pytest.mark.parametrize(("node", "match"), [
    (CALLED, r"at state\[0\]: VoxelBlocks is no tuple of 1 values"),
    (LIST, r"at state\[0\]: found list; expected Camera|found values of other types"),
    (camera(fx={"dict": [], "values": [], "id": 3}), r"at state\[0\]\.fx: found dict; expected float"),
    (camera(width="left out"), r"at state\[0\]: found the attributes .* of Camera; expected"),
    (camera(__class__=1), r"found the attributes \['__class__', "),
    ({"object": "dudmap.core.map.volume:TsdfVolume", "id": 1, "attributes": {}}, "of other types|TsdfVolume"),
    ({"object": "os:system", "id": 1, "attributes": {}}, "which this version does not know"),
    ({"scalar": "<U999999999", "value": "a"}, "not understood|expected a number"),
    ({"deque": [], "limit": "x", "id": 1}, "TypeError"),
    ({"same": 77}, "KeyError 77"),
    (camera(width=10**9), "camera image is 1000000000x30"),
    ({"model": "dudmap.core.slam:Slam", "json": "{}", "id": 1}, "Slam is no configuration"),
])  # fmt: skip
def test_a_tree_of_another_type_is_refused_with_its_place(node, match, path):
    from dudmap.core.geometry.camera import Camera

    like = {"camera": Camera(30.0, 30.0, 20.0, 15.0, 40, 30, 1000.0)}
    store(path, {"dict": ["camera"], "values": [camera()], "id": 0})
    assert restore(StateReader(path), dict(like))["camera"] == Camera(30.0, 30.0, 20.0, 15.0, 40, 30, 1000.0)
    store(path, {"dict": ["camera"], "values": [node], "id": 0})
    with pytest.raises(StateError, match="damaged or not of this program") as error:
        restore(StateReader(path), dict(like))
    assert re.search(match, str(error.value)), error.value


@pytest.mark.parametrize("array", [
    {"dtype": "|u1", "shape": [10**12], "transposed": False, "chunks": []},
    {"dtype": "|O", "shape": [0], "transposed": False, "chunks": []},
    {"dtype": "<U999999999", "shape": [1], "transposed": False, "chunks": []},
    {"dtype": "<f8", "shape": [-1], "transposed": False, "chunks": []},
    {"dtype": "<f8", "shape": "ab", "transposed": False, "chunks": []},
])  # fmt: skip
def test_arrays_have_the_size_of_what_is_stored(array, path):
    store(path, None, [array])
    with pytest.raises(StateError, match=r"is damaged: .*(array|data type)"):
        restore(StateReader(path), None)


def test_one_part_that_stands_in_many_arrays(path):
    """Equal parts are stored once; a small file must not become a large array by that."""
    with closing(sqlite3.connect(path)) as connection:
        key = connection.execute("SELECT key FROM chunks").fetchone()[0].hex()
    store(path, None, [{"dtype": "<f8", "shape": [10**7], "transposed": False, "chunks": [key] * 100_000}])
    with pytest.raises(StateError, match="its arrays have 80000000 bytes, and 800 are stored"):
        restore(StateReader(path), None)


def test_what_is_missing_in_the_state_of_a_run(tmp_path):
    """A tree that is one, but not that of a run."""
    from dudmap.app.pipeline.metrics import RunRecord
    from dudmap.app.pipeline.storing import RunState

    made = StateDatabase(tmp_path / "state.db")
    made.write(take_snapshot({"numbers": np.arange(10.0)}, made), {"next": 1})
    with pytest.raises(StateError, match="found dict; expected RunState"):
        restore(StateReader(tmp_path / "state.db"), RunState(None, RunRecord()))


def test_the_annotations_of_all_classes_of_a_state_are_known():
    """A dataclass whose annotations cannot be evaluated would be read without a look at its types."""
    from dataclasses import is_dataclass

    classes = [schema.class_of(name) for name in schema._table()]
    assert len(classes) > 100
    unknown = [cls.__name__ for cls in classes if is_dataclass(cls) and not schema._hints(cls)]
    assert unknown == []
