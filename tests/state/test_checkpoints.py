"""When a checkpoint is due."""

import time
from types import SimpleNamespace

from dudmap.app.pipeline import storing
from dudmap.app.pipeline.storing import RunState, RunStore


class NoDatabase:
    """Takes what is written and keeps nothing."""

    def write(self, snapshot, meta):
        pass

    def close(self):
        pass


STATE = RunState(SimpleNamespace(first_pass=None, arguments=None), SimpleNamespace(settle=lambda: None))


def store_of(folder, every, notice):
    """A store whose database keeps nothing."""
    store = RunStore(folder, every, notice)
    store.database.close()
    store.database = NoDatabase()
    return store


def test_a_writer_that_fails_in_any_way_does_not_end_the_run(monkeypatch, tmp_path):
    monkeypatch.setattr(storing, "take_snapshot", lambda *_, **__: None)
    said = []
    writer = store_of(tmp_path, 0.0, said.append)
    database = writer.database
    database.write = lambda snapshot, meta: 1 / 0
    for _ in range(2):
        writer.take(STATE, wait=True)
    del database.write
    writer.take(STATE, wait=True)
    writer.close(finished=False)
    assert said == [
        "the state of the run cannot be stored: ZeroDivisionError('division by zero'); it goes on in memory and tries "
        "again",
        "checkpoints are written again",
    ]
    assert writer.written == 1


def due_after(monkeypatch, folder, snapshot, seconds):
    """Whether the second checkpoint is due so many seconds after the first, which ``snapshot()`` took."""
    monkeypatch.setattr(storing, "take_snapshot", lambda *_, **__: snapshot())
    monkeypatch.setattr(storing, "FIRST", 0.0)
    writer = store_of(folder, None, print)
    writer.take(STATE, wait=True)
    time.sleep(seconds)
    due = writer.is_due
    writer.close(finished=False)
    return due


def test_checkpoints_take_their_share_of_the_time(monkeypatch, tmp_path):
    def busy():
        start = time.thread_time()
        while time.thread_time() - start < 0.1:
            pass

    assert not due_after(monkeypatch, tmp_path, busy, 0.1)


def test_a_pause_of_the_process_does_not_put_off_the_next_checkpoint(monkeypatch, tmp_path):
    """A laptop that sleeps, or a process that is stopped for minutes, while a snapshot is taken."""
    assert due_after(monkeypatch, tmp_path, lambda: time.sleep(0.3), 0.3)
