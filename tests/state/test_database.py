"""The database: keys, whole checkpoints or none, readers beside a writer, damage, writes that fail."""

import sqlite3
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import take_snapshot
from dudmap.app.state.tree import NotSettledError, TreeReader
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.pose_graph import Edge
from dudmap.errors import DudmapError, StateError
from state_differences import differences
from state_parts import restore

TINY = Camera(fx=65.6, fy=65.6, cx=39.5, cy=31.5, width=80, height=64)


def wall(distance=1.0, seed=1):
    color = np.random.default_rng(seed).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    return Frame(distance, np.full((64, 80), distance, np.float32), color)


def moved(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


HINTS = {"volume": TsdfVolume, "numbers": np.ndarray}


class Grown:
    """A map that grows, and arrays beside it, as a state that is stored again and again."""

    def __init__(self, path):
        self.volume, self.numbers = TsdfVolume(TINY), np.arange(40_000.0)
        self.database = StateDatabase(path)
        self.steps = 0

    @property
    def state(self):
        return {"volume": self.volume, "numbers": self.numbers}

    def grow(self):
        self.volume.integrate(wall(1.0 + 0.01 * self.steps), moved(0.3 * self.steps))
        self.numbers[self.steps] = -1
        self.steps += 1

    def store(self):
        self.database.write(take_snapshot(self.state, self.database), {"steps": self.steps})


def read(path):
    reader = StateReader(path)
    return restore(reader, HINTS), reader.meta()


def test_only_changed_blocks_and_parts_of_arrays_are_written(tmp_path):
    grown = Grown(tmp_path / "state.db")
    for _ in range(4):
        grown.grow()
    grown.store()
    assert grown.database._execute("SELECT count(*) FROM blocks").fetchone()[0] == grown.volume.num_blocks
    chunks = len(grown.database._chunks)
    frame = grown.volume.num_integrated
    grown.grow()
    changed = take_snapshot(grown.state, grown.database).maps[0]
    assert set(changed.slots) == set(grown.volume.written_since(frame)[0])
    assert 0 < len(changed.slots) < grown.volume.num_blocks
    grown.store()
    assert len(grown.database._execute("SELECT * FROM chunks").fetchall()) <= chunks + 8
    found, meta = read(tmp_path / "state.db")
    assert meta == {"steps": 5}
    assert differences(grown.state, found) == []
    np.testing.assert_array_equal(found["volume"].extract_mesh().vertices, grown.volume.extract_mesh().vertices)


def test_a_block_that_is_gone_leaves_the_database(tmp_path):
    grown = Grown(tmp_path / "state.db")
    for _ in range(3):
        grown.grow()
    grown.store()
    before = grown.volume.num_blocks
    for _ in range(30):  # the wall has moved away: its blocks are carved and released
        grown.volume.integrate(wall(3.0), np.eye(4))
    grown.store()
    places = set(grown.database._execute("SELECT slot, x, y, z FROM blocks"))
    slots = grown.volume.active_slots
    rows = np.column_stack([slots, grown.volume.blocks.slot_coords[slots]]).tolist()
    assert places == set(map(tuple, rows))
    assert len(grown.volume.blocks._released) > 0
    assert before
    assert differences(grown.state, read(tmp_path / "state.db")[0]) == []
    grown.volume.clear()
    grown.grow()
    grown.store()
    assert differences(grown.state, read(tmp_path / "state.db")[0]) == []
    assert grown.database._execute("SELECT count(*) FROM blocks").fetchone()[0] == grown.volume.num_blocks


def test_others_read_while_it_is_written(tmp_path):
    grown = Grown(tmp_path / "state.db")
    grown.grow()
    grown.store()
    reader = StateReader(tmp_path / "state.db")
    assert reader.meta() == {"steps": 1}
    grown.grow()
    grown.store()
    assert reader.meta() == {"steps": 1}
    old = restore(reader, HINTS)  # of one checkpoint, although another was written in between
    assert old["volume"].num_integrated == 1
    assert read(tmp_path / "state.db")[0]["volume"].num_integrated == 2


class Failing:
    """A connection of which one statement fails, as when the disk is full."""

    def __init__(self, connection, number):
        self._connection, self._left = connection, number

    def __getattr__(self, name):
        value = getattr(self._connection, name)
        if name not in ("execute", "executemany"):
            return value

        def run(statement, *arguments):
            self._left -= 1
            if self._left == 0:
                raise sqlite3.OperationalError("database or disk is full")
            return value(statement, *arguments)

        return run


def test_every_statement_that_fails_leaves_the_checkpoint_before(tmp_path):
    for number in range(1, 100):
        path = tmp_path / f"{number}.db"
        grown = Grown(path)
        grown.grow()
        grown.store()
        before = read(path)[0]
        grown.grow()
        real = grown.database._connection
        grown.database._connection = failing = Failing(real, number)
        try:
            grown.store()
        except sqlite3.OperationalError:
            pass
        grown.database._connection = real
        if failing._left > 0:
            break
        assert not real.in_transaction
        if read(path)[1] == {"steps": 1}:
            assert differences(before, read(path)[0]) == []
        grown.grow()
        grown.store()
        assert differences(grown.state, read(path)[0]) == []
    assert 8 < number < 99


def test_a_damaged_database_is_refused_in_one_sentence_or_read_as_it_was(tmp_path):
    grown = Grown(tmp_path / "state.db")
    grown.grow()
    grown.store()
    grown.database.close()
    whole = (tmp_path / "state.db").read_bytes()
    rng, sentences = np.random.default_rng(0), []
    for trial in range(150):
        damaged = bytearray(whole)
        if trial % 3 == 0:
            damaged = damaged[: rng.integers(0, len(whole))]
        for _ in range(0 if trial % 3 == 0 else int(rng.integers(1, 20))):
            place = int(rng.integers(0, len(whole) if trial % 3 == 1 else 4096))
            damaged[place] ^= 1 << int(rng.integers(0, 8))
        path = tmp_path / "damaged.db"
        path.write_bytes(damaged)
        try:
            found, _ = read(path)
        except DudmapError as error:
            sentences.append(str(error))
        else:
            np.testing.assert_array_equal(found["numbers"], grown.numbers)
            np.testing.assert_array_equal(found["volume"].blocks.geometry, grown.volume.blocks.geometry[: len(
                found["volume"].blocks.geometry)])  # fmt: skip
    assert len(sentences) > 75
    assert not any("\n" in sentence for sentence in sentences)


@pytest.mark.parametrize("column", ["meta.value", "chunks.content", "state.tree", "blocks.x", "blocks.voxels"])
@pytest.mark.parametrize("value", [None, "text"])
def test_a_value_of_another_type_is_damage(tmp_path, column, value):
    grown = Grown(tmp_path / "state.db")
    grown.grow()
    grown.store()
    grown.database.close()
    table, _, name = column.partition(".")
    with closing(sqlite3.connect(tmp_path / "state.db")) as connection, connection:
        kept = connection.execute(f"SELECT sql FROM sqlite_master WHERE name = '{table}'").fetchone()[0]
        connection.execute("PRAGMA writable_schema = 1")  # a constraint of the table is no protection
        connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", (kept.replace(" NOT NULL", ""), table))
    with closing(sqlite3.connect(tmp_path / "state.db")) as connection, connection:
        connection.execute(f"UPDATE {table} SET {name} = ?", (value,))
    with pytest.raises(StateError, match="is damaged"):
        read(tmp_path / "state.db")


def test_what_is_no_state_is_named(tmp_path):
    with pytest.raises(StateError, match="there is no state of a run at"):
        StateReader(tmp_path / "missing.db")
    (tmp_path / "text.db").write_text("no database, but long enough for its header to be looked at " * 20)
    with pytest.raises(StateError, match="is not a readable state of a run"):
        StateReader(tmp_path / "text.db")
    sqlite3.connect(tmp_path / "other.db").execute("CREATE TABLE a (b)")
    with pytest.raises(StateError, match="is not the state of a run"):
        StateReader(tmp_path / "other.db")
    database = StateDatabase(tmp_path / "new.db")
    database._execute("PRAGMA user_version = 99")
    with pytest.raises(StateError, match="version 99 of the format; this version reads 6"):
        StateReader(tmp_path / "new.db")
    StateDatabase(tmp_path / "empty.db")
    with pytest.raises(StateError, match="holds no checkpoint yet"):
        TreeReader(StateReader(tmp_path / "empty.db"))


@dataclass(eq=False)
class Kinds:
    """Values of the kinds that a state has."""

    array: NDArray[np.float64]
    number: float
    both: list[int]
    again: list[NDArray[np.float64]]
    same: list[int]
    far: NDArray[np.float64]
    empty: NDArray[np.float64]
    nan: float
    big: int
    numbers: list[int]
    generator: np.random.Generator
    seen: set[int]
    by_time: dict[float, NDArray[np.float64]]
    edges: list[Edge]
    later: Callable[[], Edge]
    running: "Future[Edge]"
    last: deque[float]
    rows: list[dict[str, Any]]
    texts: tuple[str, ...]


def kinds():
    array, both, edges = np.arange(3.0), [1, 2], [Edge(n, n + 1, np.eye(4) * n, 0.1, 0.2) for n in range(40)]
    running: Future[Edge] = Future()
    running.set_result(edges[3])
    return Kinds(
        array, np.float32(0.1), both, [array], both, np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.empty((0, 3)), float("nan"), 1 << 70, list(range(100)), np.random.default_rng(5), {3, 1},
        {0.5 * n: np.eye(4) * n for n in range(40)}, edges, lambda: edges[7], running, deque([0.5], 7),
        [{"a": 1, "b": [None, "x"]}], ("a", "b"),
    )  # fmt: skip


def test_what_is_shared_stays_shared_and_numbers_keep_their_type(tmp_path):
    state = kinds()
    state.generator.normal(size=3)
    database = StateDatabase(tmp_path / "state.db")
    database.write(take_snapshot({"kinds": state}, database), {})
    found = restore(StateReader(tmp_path / "state.db"), {"kinds": Kinds})["kinds"]
    assert found.again[0] is found.array
    assert found.same is found.both
    assert found.later() is found.edges[7]
    assert found.running.result() is found.edges[3]
    assert found.far.flags.f_contiguous
    assert found.last.maxlen == 7
    found.later = state.later
    assert differences(state, found) == []
    assert found.generator.normal() == state.generator.normal()


def test_what_cannot_be_stored_is_an_error_that_names_it(tmp_path):
    database, state = StateDatabase(tmp_path / "state.db"), kinds()
    with open(__file__) as file:
        state.array = file
        with pytest.raises(StateError, match=r"kinds.array is a _io.TextIOWrapper; expected "):
            take_snapshot({"kinds": state}, database)
    state.array = np.array([object()])
    with pytest.raises(StateError, match="array is an array of objects"):
        take_snapshot({"kinds": state}, database)
    state.array, state.running = np.zeros(3), Future()
    with pytest.raises(NotSettledError):
        take_snapshot({"kinds": state}, database, wait=False)


def test_nothing_is_stored_without_an_annotation_that_says_what_it_is(tmp_path):
    @dataclass
    class Vague:
        anything: Any
        either: "list[int] | dict[int, int]"

    for value, match in ((Vague([1], [1]), "allows for anything"), (Vague(1, [1]), "is ambiguous")):
        with pytest.raises(StateError, match=match):
            take_snapshot({"vague": value}, StateDatabase(tmp_path / "state.db"))
