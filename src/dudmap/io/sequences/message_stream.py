"""Single messages of a file whose messages lie one after the other in time: a bag, or a video of several tracks."""

from collections.abc import Callable, Generator
from threading import Lock

JUMP = 2_000_000_000
"""A message that lies further ahead than this, nanoseconds, is searched for; a nearer one is waited for in the stream,
which costs less than opening a new one."""


class MessageStream:
    """Access to messages by topic and time of recording in nanoseconds.

    Messages that are asked for in order are streamed through one pass over the file, in which those of the other topics
    that are not asked for yet are kept until they lie behind; a jump opens a new pass at the wanted time.

    Args:
        start: Opens a pass over the messages of some topics from a time on: topic, time and content of each.

    Attributes:
        lock: Held while the file is read, which may be by a thread of its own.
    """

    def __init__(self, start: Callable[[list[str], int], Generator[tuple[str, int, bytes]]]) -> None:
        self.lock = Lock()
        self._start = start
        self._passing: Generator[tuple[str, int, bytes]] | None = None
        self._kept: dict[tuple[str, int], bytes] = {}
        self._position = -1

    def read(self, wanted: list[tuple[str, int]]) -> list[bytes]:
        """Messages of these topics, which are the same in every call, at these times.

        Raises:
            KeyError: There is no such message.
        """
        with self.lock:
            missing = {key for key in wanted if key not in self._kept}
            first = min((time for _, time in missing), default=self._position)
            if missing and (self._passing is None or not 0 <= first - self._position <= JUMP):
                self.close()
                self._passing = self._start([topic for topic, _ in wanted], first)
            while missing:
                topic, time, data = next(self._passing or iter(()), ("", -1, b""))
                if time < 0:
                    self._passing = None
                    raise KeyError("there is no such message")
                self._position = time
                self._kept[topic, time] = data
                missing.discard((topic, time))
            out = [self._kept[key] for key in wanted]
            oldest = min(time for _, time in wanted)
            self._kept = {key: data for key, data in self._kept.items() if key[1] >= oldest}
        return out

    def close(self) -> None:
        """End the pass."""
        if self._passing is not None:
            self._passing.close()
        self._passing = None
        self._kept.clear()
