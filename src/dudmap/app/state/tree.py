"""State as a tree of plain values and arrays, and back; annotations of attributes determine the classes.

A value that does not fit raises an error. ``Stateful`` objects are restored in place, dataclasses and named tuples are
created from their fields; functions without arguments and futures are stored by their result. A node is a number,
text, None, or an object with an ``id``.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from enum import Enum
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from dudmap.app.state.annotations import PLAIN, RECORD, content_type, fields_of, fits, is_frozen, item_hints
from dudmap.app.state.blocks import VOXELS, MapSettings, Node, Snapshot, StoredMaps
from dudmap.core.backends.device import make_backend
from dudmap.core.map.adaptive_volume import make_volume
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore
from dudmap.core.state import Stateful, remembered
from dudmap.errors import ConfigError, DatasetError, StateError
from dudmap.input_files import DAMAGE, parse_json

if TYPE_CHECKING:
    from dudmap.app.state.blocks import StoredFrames
    from dudmap.app.state.database import StateDatabase, StateReader

LONG = 32
"""Shortest list stored as one array."""
LARGEST_COUNT = 2**23
"""Largest number of things in one array."""


class NotSettledError(Exception):
    """A background computation runs; store at a later frame."""


class TreeWriter:
    """Takes a snapshot without content that ``maps`` and ``frames`` find in the database; ``wait`` as for
    ``take_snapshot``."""

    def __init__(self, maps: StoredMaps, frames: "StoredFrames", *, wait: bool) -> None:
        self.snapshot = Snapshot()
        self._maps, self._frames, self._wait = maps, frames, wait
        self._seen: dict[int, tuple[int, object]] = {}  # number and value by identity; the value stays alive

    def take(self, parts: Mapping[str, object]) -> Snapshot:
        """Take the snapshot of named parts."""
        for name, value in parts.items():
            try:
                self.snapshot.tree[name] = self._node(value, type(value), name)
            except (TypeError, NameError) as error:  # of the annotations
                raise StateError(f"{name} cannot be stored: {error}") from error
        return self.snapshot

    def _node(self, value: Any, hint: Any, place: str, *, constant: bool = False) -> Node:  # noqa: ANN401
        if value is None or type(value) in PLAIN:
            return value
        if isinstance(value, np.generic):
            return {"scalar": value.dtype.str, "value": value.item()}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)][0]}
        number = len(self._seen)
        self._seen[id(value)] = number, value
        kind, parts = content_type(hint)
        if kind is Future and not (value.done() or self._wait):
            raise NotSettledError
        if kind in (Future, Callable):
            result = value.result() if kind is Future else value()
            return {"result": self._node(result, parts[0], place), "id": number}
        if not isinstance(kind, type) or kind is object or not isinstance(value, kind):
            raise StateError(f"{place} is a {type(value).__module__}.{type(value).__qualname__}; expected {hint}")
        return self._content(value, kind, parts, place, constant) | {"id": number}

    def _content(self, value: Any, kind: type, parts: tuple[Any, ...], place: str, constant: bool) -> dict[str, Node]:  # noqa: ANN401
        if kind is np.ndarray:
            if value.dtype.hasobject:
                raise StateError(f"{place} is an array of objects, which cannot be stored")
            if constant:
                self.snapshot.constant.add(len(self.snapshot.arrays))
            return {"array": self._add(value if constant else value.copy(order="K"))}
        if kind is np.random.Generator:
            return {"random": value.bit_generator.state}
        if issubclass(kind, Enum):
            return {"member": value.value}
        if issubclass(kind, BaseModel):
            return {"json": value.model_dump_json()}
        if issubclass(kind, Stateful):
            return self._object(value, place)
        if hints := fields_of(kind):
            content = {name: getattr(value, name) for name in hints}
            return {"fields": self._named(content, hints, place, is_frozen(kind))}
        if issubclass(kind, Mapping):
            columns = zip(("keys", "items"), (list(value), list(value.values())), parts, strict=True)
            return {name: self._items(one, [hint] * len(one), place, constant) for name, one, hint in columns}
        items = sorted(value) if kind is set else list(value)
        node = {"items": self._items(items, item_hints(kind, parts, len(items)), place, constant)}
        return node | {"limit": value.maxlen} if kind is deque else node

    def _named(self, values: dict[str, Any], hints: dict[str, Any], place: str, constant: bool) -> dict[str, Node]:
        return {
            name: self._node(values[name], hint, f"{place}.{name}", constant=constant) for name, hint in hints.items()
        }

    def _items(self, items: list[Any], hints: Sequence[Any], place: str, constant: bool) -> Node:
        kinds = {type(item) for item in items} if len(items) >= LONG else set()
        kind = kinds.pop() if len(kinds) == 1 else None
        if kind is str or hints[:1] == [RECORD]:
            return {"lines": self._add(list(items))}
        if kind is float or (kind is int and all(abs(item) < 1 << 63 for item in items)):
            return {"stack": self._add(np.array(items, np.int64 if kind is int else np.float64))}
        if kind is np.ndarray and items[0].size <= 64 and len({(one.shape, one.dtype) for one in items}) == 1:
            return {"stack": self._add(np.stack(items))}
        if kind is not None and kind is content_type(hints[0])[0] and fields_of(kind) and self._are_new(items):
            first = len(self._seen)
            self._seen |= {id(item): (first + n, item) for n, item in enumerate(items)}
            columns = {}
            for name, hint in fields_of(kind).items():
                values, where = [getattr(item, name) for item in items], f"{place}.{name}"
                columns[name] = self._items(values, [hint] * len(items), where, is_frozen(kind))
            return {"columns": columns, "first": first}
        pairs = enumerate(zip(items, hints, strict=True))
        return [self._node(item, hint, f"{place}[{n}]", constant=constant) for n, (item, hint) in pairs]

    def _are_new(self, items: list[Any]) -> bool:
        return len({id(item) for item in items} - self._seen.keys()) == len(items)

    def _object(self, value: Stateful, place: str) -> dict[str, Node]:
        node: dict[str, Node] = {}
        if isinstance(value, TsdfVolume):
            changed = self._maps.snapshot(value)
            self.snapshot.maps.append(changed)
            node = {"map": changed.number, "settings": self._node(MapSettings.of(value), MapSettings, place)}
        if isinstance(value, FrameStore):
            stored = self._frames.snapshot(value)
            self.snapshot.frames.append(stored)
            node = {"store": stored.number}
        return node | {"state": self._named(value.state(), remembered(type(value)), place, False)}

    def _add(self, array: NDArray | list[Any]) -> int:
        self.snapshot.arrays.append(array)
        return len(self.snapshot.arrays) - 1


class TreeReader:
    """Reads the parts of a stored state, in the order of writing.

    Args:
        reader: Open database, which must stay open: stored frames are read on demand.

    Raises:
        StateError: There is no state yet; all methods: it is damaged or of another version.
    """

    def __init__(self, reader: "StateReader", database: "StateDatabase | None" = None) -> None:
        self._reader, self._database, self.device = reader, database, "cpu"
        stored = reader.state()
        if stored is None:
            raise StateError(f"{reader.path} holds no checkpoint yet")
        self._tree, self._arrays = stored
        self._made: dict[int, Any] = {}
        self._at: list[str] = []  # place in the tree, for errors

    def __contains__(self, name: str) -> bool:
        return name in self._tree

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.release()

    def part(self, name: str, hint: Any, current: Any = None) -> Any:  # noqa: ANN401
        """Read a part with an annotation; a ``Stateful`` one into the new object ``current``."""
        self._at = [name]
        try:
            return self._value(self._tree[name], hint, current)
        except (*DAMAGE, DatasetError, ConfigError, MemoryError) as error:
            what = str(error) if type(error) is ValueError else f"{type(error).__name__} {error}"
            place = "".join(self._at)
            raise StateError(f"the stored state is damaged or not of this program, at {place}: {what}") from error

    def _value(self, node: Node, hint: Any, current: Any = None) -> Any:  # noqa: ANN401
        value = self._made_of(node, hint, current) if isinstance(node, dict) else node
        if not fits(value, hint):
            raise ValueError(f"found {type(value).__name__}; expected {getattr(hint, '__name__', hint)}")
        if isinstance(node, dict) and "id" in node:
            self._made[node["id"]] = value
        return value

    def _made_of(self, node: dict[str, Node], hint: Any, current: Any) -> Any:  # noqa: ANN401
        if "same" in node:
            return self._made[node["same"]]
        if "scalar" in node:
            kind = np.dtype(node["scalar"])
            if kind.kind not in "biuf" or not isinstance(node["value"], bool | int | float):
                raise ValueError(f"found a {kind} of {type(node['value']).__name__}; expected a number")
            return kind.type(node["value"])
        kind, parts = content_type(hint)
        if kind is Future:
            future: Future[Any] = Future()
            future.set_result(self._value(node["result"], parts[0]))
            return future
        if kind is Callable:
            result = self._value(node["result"], parts[0])
            return lambda: result
        if not isinstance(kind, type) or kind is object:
            raise ValueError(f"found a value of the kind {sorted(node)}; expected {hint}")
        return self._content(node, kind, parts, current)

    def _content(self, node: dict[str, Node], kind: type, parts: tuple[Any, ...], current: Any) -> Any:  # noqa: ANN401
        if kind is np.ndarray:
            return self._arrays[node["array"]]
        if kind is np.random.Generator:
            generator = np.random.default_rng(0)
            generator.bit_generator.state = node["random"]
            return generator
        if issubclass(kind, Enum):
            return kind(node["member"])
        if issubclass(kind, BaseModel):
            return kind.model_validate_json(node["json"])
        if issubclass(kind, Stateful):
            return self._object(node, kind, current)
        if hints := fields_of(kind):
            return kind(**self._named(node["fields"], hints, kind))
        if issubclass(kind, Mapping):
            keys, items = (self._items(node[name], list, parts[n : n + 1]) for n, name in enumerate(("keys", "items")))
            return dict(zip(keys, items, strict=True))
        items = self._items(node["items"], kind, parts, current)
        return deque(items, node["limit"]) if kind is deque else kind(items) if kind in (tuple, set) else items

    def _named(self, content: Node, hints: dict[str, Any], kind: type, current: object = None) -> dict[str, Any]:
        _check_names(content, hints, kind)
        out = {}
        for name, hint in hints.items():
            self._at.append(f".{name}")
            out[name] = self._value(content[name], hint, getattr(current, name, None))
            self._at.pop()
        return out

    def _items(self, node: Node, kind: type, parts: tuple[Any, ...], current: object = None) -> list[Any]:
        if isinstance(node, list):
            out, known = [], current if isinstance(current, list) and len(current) == len(node) else [None] * len(node)
            for n, (item, hint) in enumerate(zip(node, item_hints(kind, parts, len(node)), strict=True)):
                self._at.append(f"[{n}]")
                out.append(self._value(item, hint, known[n]))
                self._at.pop()
            return out
        if "columns" in node:
            return self._columns(node, content_type(parts[0])[0])
        stored = self._arrays[node["stack" if "stack" in node else "lines"]]
        if len(stored) > LARGEST_COUNT and "stack" in node:
            raise ValueError(f"found {len(stored)} values; expected {LARGEST_COUNT} or less")
        if "lines" in node:
            out = [parse_json(line, exact=True) for line in stored.tobytes().decode().splitlines()]
        else:
            out = stored.tolist() if stored.ndim == 1 else [row.copy() for row in stored]
        if parts[0] != RECORD and not all(map(fits, out, item_hints(kind, parts, len(out)))):
            raise ValueError(f"found other values than {parts}")
        return out

    def _columns(self, node: dict[str, Node], kind: type) -> list[Any]:
        hints = fields_of(kind)
        _check_names(node["columns"], hints, kind)
        columns = [self._items(node["columns"][name], list, (hint,)) for name, hint in hints.items()]
        items = [kind(**dict(zip(hints, values, strict=True))) for values in zip(*columns, strict=True)]
        self._made |= {node["first"] + n: item for n, item in enumerate(items)}
        return items

    def _object(self, node: dict[str, Node], kind: type, current: Any) -> Stateful:  # noqa: ANN401
        if issubclass(kind, TsdfVolume):
            current = self._new_map(kind, self._value(node["settings"], MapSettings))
        if not isinstance(current, kind):
            raise ValueError(f"found a {kind.__name__}, which a new object of this kind does not have")
        assert isinstance(current, Stateful)
        self._made[node["id"]] = current  # its content may refer to it
        current.restore(self._named(node["state"], remembered(type(current)), kind, current))
        if isinstance(current, TsdfVolume):
            self._fill_map(current, node["map"])
        if isinstance(current, FrameStore):
            self._connect_frames(current, node["store"])
        return current

    def _new_map(self, kind: type[TsdfVolume], settings: MapSettings) -> TsdfVolume:
        if kind is not TsdfVolume:
            return kind(*settings[:4])
        backend = make_backend("cpu" if settings.config.adaptive else self.device)
        return make_volume(*settings[:4], backend, settings.max_blocks)

    def _fill_map(self, volume: TsdfVolume, number: int) -> None:
        reader, blocks = self._reader, volume.blocks
        slots, coords, voxels = reader.blocks(number)
        owned = blocks.active_slots
        if not (np.array_equal(slots, owned) and np.array_equal(coords, blocks.slot_coords[owned])):
            raise StateError(f"the stored map is damaged: {len(slots)} of {len(owned)} blocks fit its index")
        blocks.write(slots, voxels[:, : VOXELS // 2], voxels[:, VOXELS // 2 :])
        if volume.pager is not None:
            volume.pager.continue_from(lambda region: reader.region(number, region))
        if self._database is not None:
            self._database.maps.add(volume, number)

    def _connect_frames(self, store: FrameStore, number: int) -> None:
        reader = self._reader
        if reader.frames(number) != store.kept:
            raise StateError(f"the state of the run in {reader.path} is damaged: stored frames are missing")
        store.continue_from(lambda n: reader.frame(number, n))
        if self._database is not None:
            self._database.frames.add(store, number)


def _check_names(content: object, hints: Iterable[str], kind: type) -> None:
    if not isinstance(content, dict) or content.keys() != set(hints):
        found = sorted(content) if isinstance(content, dict) else content
        raise ValueError(f"found the attributes {found} of {kind.__name__}; expected {sorted(hints)}")
