"""Stored frames on their way into the database: each is written once."""

from dataclasses import dataclass

from dudmap.places.frame_store import EncodedFrame, FrameStore


@dataclass(frozen=True, eq=False)
class FrameSnapshot:
    """What changed in a frame store since the last checkpoint.

    Attributes:
        number: Number of the store in the database.
        first: Number of the first frame that the database lacks; those from it on are replaced.
        frames: The frames from there on: depth, colour and mask as files.
        places: Places of all frames in the file of the store, by which a replaced frame is noticed.
        store: The store.
    """

    number: int
    first: int
    frames: list[EncodedFrame]
    places: list[object]
    store: FrameStore


class StoredFrames:
    """Knows which frames are in the database."""

    def __init__(self) -> None:
        self._stores: list[tuple[FrameStore, list[object]]] = []  # the number is the place in the list

    def snapshot(self, store: FrameStore) -> FrameSnapshot:
        """The frames that the database lacks; waits until they are encoded."""
        number = next((n for n, (one, _) in enumerate(self._stores) if one is store), len(self._stores))
        if number == len(self._stores):
            self._stores.append((store, []))
        places, stored = store.places(), self._stores[number][1]
        first = min(len(stored), len(places))
        while first > 0 and stored[first - 1] != places[first - 1]:
            first -= 1
        return FrameSnapshot(number, first, [store.encoded(n) for n in range(first, len(store))], places, store)

    def commit(self, frames: list[FrameSnapshot]) -> None:
        """What these snapshots hold is in the database."""
        for changed in frames:
            self._stores[changed.number] = changed.store, changed.places

    def add(self, store: FrameStore, number: int) -> None:
        """The frames of a store come from the database."""
        while len(self._stores) <= number:
            self._stores.append((store, []))
        self._stores[number] = store, store.places()
