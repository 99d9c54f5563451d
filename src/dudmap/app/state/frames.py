"""Stored frames on their way into the database: each is written once."""

from dataclasses import dataclass

from dudmap.core.places.frame_store import EncodedFrame, FrameStore


@dataclass(frozen=True, eq=False)
class FrameSnapshot:
    """What changed in a frame store since the last checkpoint.

    Attributes:
        number: Number of the store in the database.
        frames: The frames that the database lacks, by number: depth, colour and mask as files.
        gone: Numbers of those that it holds, and the store does not any more.
        kept: Numbers of the frames whose images are in the store.
        store: The store.
    """

    number: int
    frames: dict[int, EncodedFrame]
    gone: list[int]
    kept: set[int]
    store: FrameStore


class StoredFrames:
    """Knows which frames are in the database."""

    def __init__(self) -> None:
        self._stores: list[tuple[FrameStore, set[int]]] = []  # the number is the place in the list

    def snapshot(self, store: FrameStore) -> FrameSnapshot:
        """The frames that the database lacks, and those that it no longer needs; waits until the former are encoded."""
        number = next((n for n, (one, _) in enumerate(self._stores) if one is store), len(self._stores))
        if number == len(self._stores):
            self._stores.append((store, set()))
        stored, kept = self._stores[number][1], set(store.kept)
        frames = {n: store.encoded(n) for n in store.kept if n not in stored}
        return FrameSnapshot(number, frames, sorted(stored - kept), kept, store)

    def commit(self, frames: list[FrameSnapshot]) -> None:
        """What these snapshots hold is in the database."""
        for changed in frames:
            self._stores[changed.number] = changed.store, changed.kept

    def add(self, store: FrameStore, number: int) -> None:
        """The frames of a store come from the database."""
        while len(self._stores) <= number:
            self._stores.append((store, set()))
        self._stores[number] = store, set(store.kept)
