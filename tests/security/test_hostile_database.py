"""A database of a run from elsewhere is data: it runs nothing, and is bounded in memory and time."""

import os
import signal
import sqlite3
import threading
import time
import zlib
from contextlib import closing

import numpy as np
import pytest

from dudmap.errors import StateError
from dudmap.state import database
from dudmap.state.database import StateDatabase, StateReader
from dudmap.state.system import restore, take_snapshot

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


def test_ctrl_c_and_a_limit_end_an_endless_query(path, monkeypatch):
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
