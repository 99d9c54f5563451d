"""Temporary file of byte strings."""

import sqlite3
import tempfile
import threading
import weakref
from collections.abc import Sequence

from dudmap.errors import MapError


class ScratchStore:
    """Lists of byte strings by keys, in a temporary SQLite database. Thread-safe."""

    def __init__(self, content: str) -> None:
        self._content = content
        self._lock = threading.Lock()
        self._connection = connection = sqlite3.connect("", check_same_thread=False)  # a file without a name
        connection.execute("PRAGMA journal_mode = MEMORY")
        connection.execute("CREATE TABLE parts (key TEXT, number INTEGER, part BLOB, PRIMARY KEY (key, number))")
        self.close = weakref.finalize(self, _close, connection, self._lock)

    def write(self, key: str, parts: Sequence[bytes | memoryview]) -> None:
        """Replace the parts of a key.

        Raises:
            MapError: The file cannot be written.
        """
        try:
            with self._lock, self._connection:
                self._connection.execute("DELETE FROM parts WHERE key = ?", (key,))
                rows = ((key, number, part) for number, part in enumerate(parts))
                self._connection.executemany("INSERT INTO parts VALUES (?, ?, ?)", rows)
        except sqlite3.Error as error:
            raise MapError(
                f"{self._content} cannot be stored in {tempfile.gettempdir()}: {error}; make room there, or name "
                "another folder in the environment variable TMPDIR"
            ) from error

    def read(self, key: str) -> list[bytes]:
        """The parts of a key.

        Raises:
            MapError: The file cannot be read, or has no such key.
        """
        try:
            with self._lock:
                query = "SELECT part FROM parts WHERE key = ? ORDER BY number"
                rows = self._connection.execute(query, (key,)).fetchall()
        except sqlite3.Error as error:
            raise MapError(f"{self._content} cannot be read from {tempfile.gettempdir()}: {error}") from error
        if not rows:
            raise MapError(f"{self._content}: {key} is missing in {tempfile.gettempdir()}")
        return [part for (part,) in rows]

    def remove(self, key: str) -> None:
        """Forget a key."""
        with self._lock, self._connection:
            self._connection.execute("DELETE FROM parts WHERE key = ?", (key,))


def _close(connection: sqlite3.Connection, lock: threading.Lock) -> None:
    with lock:  # closing a connection that another thread uses crashes the process
        connection.close()
