"""When a checkpoint is due."""

import time

from dudmap.app.state import checkpoints
from dudmap.app.state.checkpoints import Checkpoints


class NoDatabase:
    """Takes what is written and keeps nothing."""

    def write(self, snapshot, meta):
        pass

    def close(self):
        pass


def test_a_writer_that_fails_in_any_way_does_not_end_the_run(monkeypatch):
    monkeypatch.setattr(checkpoints, "take_snapshot", lambda *_, **__: None)
    said, database = [], NoDatabase()
    writer = Checkpoints(database, 0.0, said.append)
    database.write = lambda snapshot, meta: 1 / 0
    for _ in range(2):
        writer.take(None, {}, wait=True)
    del database.write
    writer.take(None, {}, wait=True)
    writer.close()
    assert said == [
        "the state of the run cannot be stored: ZeroDivisionError('division by zero'); it goes on in memory and tries "
        "again",
        "checkpoints are written again",
    ]
    assert writer.written == 1


def due_after(monkeypatch, snapshot, seconds):
    """Whether the second checkpoint is due so many seconds after the first, which ``snapshot()`` took."""
    monkeypatch.setattr(checkpoints, "take_snapshot", lambda *_, **__: snapshot())
    monkeypatch.setattr(checkpoints, "FIRST", 0.0)
    writer = Checkpoints(NoDatabase(), None, print)
    writer.take(None, {}, wait=True)
    time.sleep(seconds)
    due = writer.is_due
    writer.close()
    return due


def test_checkpoints_take_their_share_of_the_time(monkeypatch):
    def busy():
        start = time.thread_time()
        while time.thread_time() - start < 0.1:
            pass

    assert not due_after(monkeypatch, busy, 0.1)


def test_a_pause_of_the_process_does_not_put_off_the_next_checkpoint(monkeypatch):
    """A laptop that sleeps, or a process that is stopped for minutes, while a snapshot is taken."""
    assert due_after(monkeypatch, lambda: time.sleep(0.3), 0.3)
