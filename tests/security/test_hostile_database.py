"""A database of a run from elsewhere is data: it runs nothing, and is bounded in memory and time."""

import json
import os
import re
import signal
import sqlite3
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import closing
from enum import Enum
from typing import get_args

import numpy as np
import pytest
from pydantic import BaseModel

from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.state import database
from dudmap.app.state.annotations import RECORD, content_type, fields_of
from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import parts_of, read_system, take_snapshot
from dudmap.app.state.tree import TreeReader
from dudmap.config import Config
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.slam import Slam
from dudmap.core.state import Stateful, remembered
from dudmap.core.tracking.motion_model import MotionModel
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
    with pytest.raises(StateError, match="damaged or not of this program: it has other tables than a state"):
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
        TreeReader(StateReader(path))


def test_a_journal_is_not_played_back(path, tmp_path):
    """A rollback journal may name another file, which SQLite deletes afterwards."""
    path.with_name("state.db-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(1000))
    with pytest.raises(StateError, match=r"found a state\.db-journal next to .*: remove it"):
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


def camera(**changes):
    values = {"fx": 30.0, "fy": 30.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30, "depth_scale": 1000.0,
              "distortion": {"items": [], "id": 2}} | changes  # fmt: skip
    return {"fields": {key: value for key, value in values.items() if value != "left out"}, "id": 1}


@pytest.mark.parametrize(("node", "match"), [
    ({"items": [1, 2], "id": 1}, "at part: KeyError 'fields'"),
    (camera(fx={"keys": [], "items": [], "id": 3}), r"at part\.fx: found a value of the kind .*; expected .*float"),
    (camera(fx="wide"), r"at part\.fx: found str; expected float"),
    (camera(width=40.5), r"at part\.width: found float; expected int"),
    (camera(width="left out"), r"at part: found the attributes .* of Camera; expected"),
    (camera(__class__=1), r"found the attributes \['__class__', "),
    (camera(distortion={"items": [{"same": 77}], "id": 2}), r"at part\.distortion\[0\]: KeyError 77"),
    (camera(distortion={"items": [0.1, "a"], "id": 2}), r"at part\.distortion\[1\]: found str; expected float"),
    (camera(fx={"scalar": "<U999999999", "value": "a"}), "not understood|expected a number"),
    (camera(width=10**9), "camera image is 1000000000x30"),
    ({"object": "os:system", "id": 1, "attributes": {}}, "KeyError 'fields'"),
    (None, "found NoneType; expected Camera"),
    ("os.system", "found str; expected Camera"),
])  # fmt: skip
def test_a_tree_of_another_type_is_refused_with_its_place(node, match, path):
    from dudmap.core.geometry.camera import Camera

    store(path, {"part": camera()})
    found = TreeReader(StateReader(path)).part("part", Camera)
    assert found == Camera(30.0, 30.0, 20.0, 15.0, 40, 30, 1000.0)
    store(path, {"part": node})
    with pytest.raises(StateError, match="damaged or not of this program") as error:
        TreeReader(StateReader(path)).part("part", Camera)
    assert re.search(match, str(error.value)), error.value


@pytest.mark.parametrize(("hint", "node", "match"), [
    (deque[float], {"items": [], "limit": "x", "id": 1}, "TypeError"),
    (tuple[int, str], {"items": [1], "id": 1}, "found 1 values; expected 2"),
    (MotionModel, {"state": {}, "id": 1}, "found a MotionModel, which a new object of this kind does not have"),
    (Config, {"json": "{}", "__class__": 1, "id": 1}, ""),
    (Config, {"json": '{"no such section": 1}', "id": 1}, "ConfigError unknown configuration key"),
    (list[str], {"items": {"stack": 0}, "id": 1}, "found other values than"),
    (Callable[[], str], {"result": 1, "id": 1}, "found int; expected str"),
    (TsdfVolume, {"map": 0, "state": {}, "id": 1}, "KeyError 'settings'"),
])  # fmt: skip
def test_what_does_not_fit_its_annotation_is_refused(hint, node, match, path):
    with closing(sqlite3.connect(path)) as connection:
        key = connection.execute("SELECT key FROM chunks").fetchone()[0].hex()
    store(path, {"part": node}, [{"dtype": "<f8", "shape": [100], "transposed": False, "chunks": [key]}])
    tree = TreeReader(StateReader(path))
    if not match:
        assert tree.part("part", hint) == Config()
        return
    with pytest.raises(StateError, match=match):
        tree.part("part", hint)


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
        TreeReader(StateReader(path))


def test_one_part_that_stands_in_many_arrays(path):
    """Equal parts are stored once; a small file must not become a large array by that."""
    with closing(sqlite3.connect(path)) as connection:
        key = connection.execute("SELECT key FROM chunks").fetchone()[0].hex()
    store(path, None, [{"dtype": "<f8", "shape": [10**7], "transposed": False, "chunks": [key] * 100_000}])
    with pytest.raises(StateError, match="its arrays have 80000000 bytes, and 800 are stored"):
        TreeReader(StateReader(path))


def test_what_is_missing_in_the_state_of_a_run(path):
    """A tree that is one, but not that of a run."""
    with pytest.raises(StateError, match="at arguments: KeyError 'arguments'"):
        read_system(TreeReader(StateReader(path)), None)


def reachable(*hints):
    """All classes that the annotations of a class lead to."""
    found, todo = set(), list(hints)
    while todo:
        kind, parts = content_type(todo.pop())
        if kind in found or kind in (object, np.ndarray):
            continue
        assert isinstance(kind, type) or kind is Callable
        found.add(kind) if not parts else None
        todo += [part for part in parts if part is not ... and (kind, parts) != (dict, get_args(RECORD))]
        if isinstance(kind, type):
            todo += (remembered(kind) if issubclass(kind, Stateful) else fields_of(kind)).values()
    return found


def test_a_state_leads_to_classes_of_this_program_alone():
    """Whatever is stored, nothing else can be made of it; and every annotation says what it is."""
    slam = Slam(Camera(30.0, 30.0, 20.0, 15.0, 40, 30))
    found = reachable(*map(type, parts_of(slam).values()), RunRecord, Calibration)
    ours = {kind for kind in found if kind.__module__.startswith("dudmap.")}
    assert found - ours == {np.random.Generator}
    assert len(ours) > 70
    stateless = [kind for kind in ours if not issubclass(kind, Stateful | BaseModel | Enum) and not fields_of(kind)]
    assert stateless == []
