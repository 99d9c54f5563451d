"""The database: keys, whole checkpoints or none, readers beside a writer, damage, writes that fail."""

import sqlite3
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap.app.state.database import StateDatabase, StateReader
from dudmap.app.state.system import restore, take_snapshot
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.errors import DudmapError, StateError
from state_differences import differences

TINY = Camera(fx=65.6, fy=65.6, cx=39.5, cy=31.5, width=80, height=64)


def wall(distance=1.0, seed=1):
    color = np.random.default_rng(seed).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    return Frame(distance, np.full((64, 80), distance, np.float32), color)


def moved(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


class Grown:
    """A map that grows, and arrays beside it, as a state that is stored again and again."""

    def __init__(self, path):
        self.volume, self.value = TsdfVolume(TINY), {"numbers": np.arange(40_000.0)}
        self.database = StateDatabase(path)
        self.steps = 0

    @property
    def state(self):
        return {"volume": self.volume, **self.value}

    def grow(self):
        self.volume.integrate(wall(1.0 + 0.01 * self.steps), moved(0.3 * self.steps))
        self.value["numbers"][self.steps] = -1
        self.steps += 1

    def store(self):
        self.database.write(take_snapshot(self.state, self.database), {"steps": self.steps})


def read(path):
    reader = StateReader(path)
    return restore(reader, {"volume": TsdfVolume(TINY)}), reader.meta()


def assert_same(tmp_path, a, b):
    snapshots = []
    for n, state in enumerate((a, b)):
        (tmp_path / f"compare{n}").unlink(missing_ok=True)
        snapshots.append(take_snapshot(state, StateDatabase(tmp_path / f"compare{n}")))
    assert differences(*snapshots) == []


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
    assert_same(tmp_path, grown.state, found)
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
    assert_same(tmp_path, grown.state, read(tmp_path / "state.db")[0])
    grown.volume.clear()
    grown.grow()
    grown.store()
    assert_same(tmp_path, grown.state, read(tmp_path / "state.db")[0])
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
    old = restore(reader, {"volume": TsdfVolume(TINY)})  # of one checkpoint, although another was written in between
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
            assert_same(tmp_path, before, read(path)[0])
        grown.grow()
        grown.store()
        assert_same(tmp_path, grown.state, read(path)[0])
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
            np.testing.assert_array_equal(found["numbers"], grown.value["numbers"])
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
    with pytest.raises(StateError, match="version 99 of the format; this version reads 3"):
        StateReader(tmp_path / "new.db")
    StateDatabase(tmp_path / "empty.db")
    with pytest.raises(StateError, match="holds no checkpoint yet"):
        restore(StateReader(tmp_path / "empty.db"), None)


def test_what_cannot_be_stored_is_an_error_that_names_it(tmp_path):
    database = StateDatabase(tmp_path / "state.db")
    volume = TsdfVolume(TINY)
    volume.forgotten = open(__file__)
    with volume.forgotten, pytest.raises(StateError, match=r"state\[0\].forgotten is a _io.TextIOWrapper"):
        take_snapshot([volume], database)
    volume.forgotten = lambda: 1
    with pytest.raises(StateError, match=r"forgotten is a builtins\.function"):
        take_snapshot([volume], database)
    volume.forgotten = np.array([object()])
    with pytest.raises(StateError, match="forgotten is an array of objects"):
        take_snapshot([volume], database)


def test_an_attribute_that_is_not_restored_is_noticed(tmp_path):
    a, b = TsdfVolume(TINY), TsdfVolume(TINY)
    a.integrate(wall(), np.eye(4))
    b.integrate(wall(), np.eye(4))
    assert_same(tmp_path, a, b)
    a.added_later = 1.0
    with pytest.raises(AssertionError, match="added_later"):
        assert_same(tmp_path, a, b)
    b.added_later = 2.0
    with pytest.raises(AssertionError, match=r"added_later: 1\.0 and 2\.0"):
        assert_same(tmp_path, a, b)


def test_no_class_from_elsewhere_is_made():
    from dudmap.app.state.tree import TreeReader

    for name in (
        "subprocess:Popen",
        "builtins:object",
        "dudmap.app.pipeline.run:Job",
        "dudmap.core.slam:np",
        "os:system",
    ):
        reader = SimpleNamespace(state=lambda name=name: ({"object": name, "id": 0, "attributes": {}}, []))
        with pytest.raises(StateError, match="does not know"):
            TreeReader(reader).restore(None)


def test_what_is_shared_stays_shared_and_numbers_keep_their_type(tmp_path):
    array, number, both = np.arange(3.0), np.float32(0.1), [1, 2]
    itself: list = []
    itself.append(itself)
    far = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    state = {
        "a": [array, number, both],
        "b": (array, number, both),
        "itself": itself,
        "far": far,
        "empty": np.empty((0, 3)),
    }
    state |= {"nan": float("nan"), "big": 1 << 70, "numbers": list(range(100)), "random": np.random.default_rng(5)}
    state |= {"set": {3, 1}, "keys": {0.5 * n: np.eye(4) * n for n in range(40)}}
    state["random"].normal(size=3)
    database = StateDatabase(tmp_path / "state.db")
    database.write(take_snapshot(state, database), {})
    found = restore(StateReader(tmp_path / "state.db"), {})
    assert found["a"][0] is found["b"][0]
    assert found["a"][2] is found["b"][2]
    assert type(found["b"][1]) is np.float32
    assert found["itself"][0] is found["itself"]
    assert found["far"].flags.f_contiguous
    assert found["nan"] != found["nan"]
    assert found["random"].normal() == state["random"].normal()
    np.testing.assert_array_equal(found["keys"][7.5], np.eye(4) * 15)
    for key in ("big", "numbers", "set"):
        assert found[key] == state[key]
    assert found["empty"].shape == (0, 3)
