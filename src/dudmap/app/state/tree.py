"""The state of a system as a tree of plain values and arrays, and a system with the state of such a tree.

The tree is found by walking through all attributes of all objects, so that no class needs to list what it remembers,
and an attribute that is added later is stored without further work. What cannot be stored (a thread, an open file, a
function) is an error unless ``schema.py`` says how it is made again. Nothing is executed when a tree is read: objects
are made of the classes of a table only, without calling them, and receive the attributes that ``schema.py`` allows.

A node is a number, a text, None, or an object with one key that names its kind.
"""

from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from dudmap.app.state import schema
from dudmap.app.state.blocks import MapSnapshot, StoredMaps, restore_map
from dudmap.core.backends.device import make_backend
from dudmap.core.geometry.camera import Camera
from dudmap.core.map.volume import TsdfVolume
from dudmap.core.places.frame_store import FrameStore
from dudmap.errors import DatasetError, StateError
from dudmap.input_files import DAMAGE, parse_json

if TYPE_CHECKING:
    from dudmap.app.state.blocks import FrameSnapshot, StoredFrames
    from dudmap.app.state.database import StateDatabase, StateReader

Node = Any
"""A tree of plain values, as JSON has them."""
LONG = 32
"""Length from which on a list of equal things is stored as one array."""


@dataclass(eq=False)
class Snapshot:
    """The state of a system at one moment, which no later change reaches.

    Attributes:
        tree: The tree; ``arrays`` are referred to by number.
        arrays: Copies, except of what never changes; or lists of plain values.
        constant: Numbers of the arrays that never change.
        maps, frames: What changed in the maps and stored frames since the last checkpoint.
    """

    tree: Node = None
    arrays: list[NDArray | list[Any]] = field(default_factory=list)
    constant: set[int] = field(default_factory=set)
    maps: list[MapSnapshot] = field(default_factory=list)
    frames: "list[FrameSnapshot]" = field(default_factory=list)


class NotSettledError(Exception):
    """Something is being computed in the background; the state can be stored at a later frame."""


class TreeWriter:
    """Takes a snapshot, without what ``maps`` and ``frames`` know to be in the database; for ``wait`` see
    ``take_snapshot``."""

    def __init__(self, maps: StoredMaps, frames: "StoredFrames", *, wait: bool) -> None:
        self.snapshot = Snapshot()
        self._maps, self._frames, self._wait = maps, frames, wait
        self._seen: dict[int, tuple[int, object]] = {}  # number and value by identity, which the value keeps alive

    def take(self, value: object) -> Snapshot:
        """The snapshot of a value and everything that it refers to."""
        self.snapshot.tree = self._node(value, "state")
        return self.snapshot

    def _node(self, value: Any, place: str, *, constant: bool = False) -> Node:  # noqa: ANN401
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {"scalar": value.dtype.str, "value": value.item()}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)][0]}
        number = len(self._seen)
        self._seen[id(value)] = number, value
        if type(value).__name__ in schema.BACKENDS:
            return {"backend": number}
        if isinstance(value, np.ndarray):
            return {"array": self._array(value, place, constant=constant), "id": number}
        if isinstance(value, BaseModel):
            return {"model": _class_name(value, place), "json": value.model_dump_json(), "id": number}
        if isinstance(value, np.random.Generator):
            return {"random": value.bit_generator.state, "id": number}
        if isinstance(value, Future):
            return {"result": self._node(self._result(value), place), "id": number}
        if isinstance(value, tuple):
            items = [self._node(item, f"{place}[{n}]", constant=constant) for n, item in enumerate(value)]
            node = {"tuple": items, "id": number}
            return node | {"class": _class_name(value, place)} if type(value) is not tuple else node
        if isinstance(value, list):
            return {"list": self._items(value, place), "id": number}
        if isinstance(value, deque):
            return {"deque": self._items(list(value), place), "limit": value.maxlen, "id": number}
        if isinstance(value, dict):
            keys, content = list(value), list(value.values())
            return {"dict": self._items(keys, f"{place}.keys"), "values": self._items(content, place), "id": number}
        if isinstance(value, set):
            return {"set": self._items(sorted(value), place), "id": number}
        return self._object(value, place, number)

    def _items(self, items: list[Any], place: str) -> Node:
        """Items of a list: one by one, or as an array where they are many of one kind."""
        kinds = {type(item) for item in items} if len(items) >= LONG else set()
        if len(kinds) == 1:
            kind = kinds.pop()
            if kind in (int, float) and not (kind is int and any(abs(item) >= 1 << 63 for item in items)):
                return {"numbers": self._add(np.array(items, np.int64 if kind is int else np.float64))}
            if kind is np.ndarray and items[0].size <= 64 and len({(a.shape, a.dtype) for a in items}) == 1:
                return {"stack": self._add(np.stack(items))}
            if kind.__name__ in schema.COLUMNS and schema.is_state_class(kind):
                names = list(schema.attributes(items[0]))
                columns = [self._items([getattr(item, name) for item in items], f"{place}.{name}") for name in names]
                return {"columns": schema.name_of(kind), "names": names, "values": columns, "count": len(items)}
        return [self._node(item, f"{place}[{n}]") for n, item in enumerate(items)]

    def _object(self, value: object, place: str, number: int) -> Node:
        cls = type(value)
        if not schema.is_state_class(cls) or not hasattr(value, "__dict__"):
            raise StateError(f"{place} is a {cls.__module__}.{cls.__qualname__}, which cannot be stored")
        evaluated, records = schema.EVALUATED.get(cls.__name__, ()), schema.RECORDS.get(cls.__name__, ())
        node: dict[str, Node] = {"object": schema.name_of(cls), "id": number}
        if isinstance(value, TsdfVolume):
            state, changed = self._maps.snapshot(value)
            self.snapshot.maps.append(changed)
            node |= {"map": changed.number, "blocks": self._node(state, place)}
        if isinstance(value, FrameStore):
            changed = self._frames.snapshot(value)
            self.snapshot.frames.append(changed)
            node |= {"store": changed.number}
        content = {}
        for name, attribute in schema.attributes(value).items():
            where = f"{place}.{name}"
            if name in records:
                content[name] = {"records": self._add(list(attribute))}
            elif name in evaluated:
                content[name] = {"call": self._node(attribute(), where)}
            else:
                content[name] = self._node(attribute, where, constant=cls.__name__ in schema.CONSTANT)
        return node | {"attributes": content}

    def _array(self, array: NDArray, place: str, *, constant: bool) -> int:
        if array.dtype.hasobject:
            raise StateError(f"{place} is an array of objects, which cannot be stored")
        if constant:
            self.snapshot.constant.add(len(self.snapshot.arrays))
        return self._add(array if constant else array.copy(order="K"))

    def _add(self, array: NDArray | list[Any]) -> int:
        self.snapshot.arrays.append(array)
        return len(self.snapshot.arrays) - 1

    def _result(self, future: "Future[Any]") -> Any:  # noqa: ANN401
        if not (future.done() or self._wait):
            raise NotSettledError
        return future.result()


class TreeReader:
    """Gives a system the state that a database holds; for the arguments see ``system.restore``."""

    def __init__(self, reader: "StateReader", database: "StateDatabase | None" = None, device: str = "cpu") -> None:
        self._reader, self._database, self._device = reader, database, device
        stored = reader.state()
        if stored is None:
            raise StateError(f"{reader.path} holds no checkpoint yet")
        self._tree, self._arrays = stored
        self._made: dict[int, Any] = {}
        self._at: list[str] = []  # where the tree is being read, which an error names
        self._new: dict[type, dict[str, Any]] = {}  # attributes of a new object by class
        self._taken: set[int] = set()  # identities of the objects of the given system that are in use

    def restore(self, current: object) -> Any:  # noqa: ANN401
        """The value that was stored last.

        The objects of ``current``, a new value of the same kind, are used, so that they stay connected.

        Raises:
            StateError: The state is damaged or of another version.
        """
        try:
            value = self._value(self._tree, current)
            if not schema.is_alike(value, current):
                raise ValueError(f"found {type(value).__name__}; expected {type(current).__name__}")
            return value
        except (*DAMAGE, DatasetError, MemoryError) as error:
            place = "".join(["state", *self._at])
            what = str(error) if type(error) is ValueError else f"{type(error).__name__} {error}"
            raise StateError(f"the stored state is damaged or not of this program, at {place}: {what}") from error

    def _value(self, node: Node, current: Any = None) -> Any:  # noqa: ANN401
        if not isinstance(node, dict):
            return node
        match node:
            case {"same": number}:
                return self._made[number]
            case {"backend": number}:
                usable = type(current).__name__ in schema.BACKENDS and id(current) not in self._taken
                return self._use(number, current if usable else make_backend(self._device))
            case {"scalar": name, "value": value}:
                kind = np.dtype(name)
                if kind.kind not in "biuf" or not isinstance(value, bool | int | float):
                    raise ValueError(f"found a {kind} of {type(value).__name__}; expected a number")
                return kind.type(value)
            case {"records": number}:
                lines = self._arrays[number].tobytes().decode().splitlines()
                return [parse_json(line, exact=True) for line in lines]
            case {"call": result}:
                made = self._value(result)
                return lambda: made
            case {"object": _}:
                return self._object(node, current)
            case {"array": number}:
                value = self._arrays[number]
            case {"model": name, "json": text}:
                cls = schema.class_of(name)
                if not issubclass(cls, BaseModel):
                    raise ValueError(f"{cls.__name__} is no configuration")
                value = cls.model_validate_json(text)
            case {"random": state}:
                value = np.random.default_rng(0)
                value.bit_generator.state = state
            case {"result": result}:
                value = Future()
                value.set_result(self._value(result))
            case {"tuple": items}:
                value = self._tuple(self._items(items), node.get("class"))
            case {"set": items}:
                value = set(self._items(items))
            case {"list": items, "id": number}:  # this and the next may be part of their own content
                value = self._made[number] = []
                value += self._items(items, current)
            case {"deque": items, "limit": limit, "id": number}:
                value = self._made[number] = deque(maxlen=limit)
                value.extend(self._items(items))
            case {"dict": names, "values": items, "id": number}:
                value = self._made[number] = {}
                keys = self._items(names)
                known = [current.get(key) for key in keys] if isinstance(current, dict) else []
                content = self._items(items, known)
                if not all(map(schema.is_alike, content, known or content)):
                    raise ValueError(f"found values of other types than those of {keys}")
                value.update(zip(keys, content, strict=True))
            case _:
                raise ValueError(f"found a value of the kind {sorted(node)}")
        self._made[node["id"]] = value
        return value

    def _use(self, number: int, value: Any) -> Any:  # noqa: ANN401
        """Note that an object stands for a number of the tree and for no other."""
        self._made[number] = value
        self._taken.add(id(value))
        return value

    def _tuple(self, items: list[Any], name: str | None) -> tuple[Any, ...]:
        if name is None:
            return tuple(items)
        cls: Any = schema.class_of(name)
        if not issubclass(cls, tuple) or len(items) != len(getattr(cls, "_fields", ())):
            raise ValueError(f"{cls.__name__} is no tuple of {len(items)} values")
        return tuple.__new__(cls, items)

    def _items(self, node: Node, current: Any = None) -> list[Any]:  # noqa: ANN401
        if isinstance(node, list):
            known = current if isinstance(current, list) and len(current) == len(node) else [None] * len(node)
            out = []
            for n, (item, one) in enumerate(zip(node, known, strict=True)):
                self._at.append(f"[{n}]")
                out.append(self._value(item, one))
                self._at.pop()
            return out
        if "numbers" in node:
            return self._arrays[node["numbers"]].tolist()
        if "stack" in node:
            stack = self._arrays[node["stack"]]
            if len(stack) > schema.LARGEST_COUNT:
                raise ValueError(f"found {len(stack)} arrays; expected {schema.LARGEST_COUNT} or less")
            return [row.copy() for row in stack]
        cls = schema.class_of(node["columns"])
        columns = [self._items(column) for column in node["values"]]
        schema.check_attributes(cls, dict.fromkeys(node["names"]), {})
        out = []
        for values in zip(*columns, strict=True):
            out.append(object.__new__(cls))
            for name, value in zip(node["names"], values, strict=True):
                schema.check_value(cls, name, value, None)
                object.__setattr__(out[-1], name, value)
        return out

    def _object(self, node: dict[str, Node], current: Any) -> Any:  # noqa: ANN401
        cls = schema.class_of(node["object"])
        frozen = is_dataclass(cls) and getattr(cls, "__dataclass_params__").frozen  # noqa: B009 - not in the stubs
        usable = type(current) is cls and id(current) not in self._taken and not frozen
        if issubclass(cls, BaseModel | tuple) or not hasattr(cls, "__dict__"):
            raise ValueError(f"{cls.__name__} is no class of plain objects")
        value: Any = self._use(node["id"], current if usable else object.__new__(cls))
        content = node["attributes"]
        like = self._new.setdefault(cls, schema.attributes(current)) if usable else self._new.get(cls, {})
        schema.check_attributes(cls, content, like)
        for name, default in {} if usable else schema.defaults(cls).items():
            object.__setattr__(value, name, default)
        for name, attribute in content.items():
            self._at.append(f".{name}")
            made = self._value(attribute, getattr(current, name, None))
            schema.check_value(cls, name, made, like.get(name))
            self._at.pop()
            object.__setattr__(value, name, made)
        if cls is Camera:
            value.__post_init__()  # its size decides how much memory is taken
        if "map" in node:
            self._fill_map(value, node["map"], self._value(node["blocks"]))
        if "store" in node:
            self._connect_frames(value, node["store"])
        return value

    def _fill_map(self, volume: TsdfVolume, number: int, index: dict[str, Any]) -> None:
        reader = self._reader
        restore_map(volume, index, *reader.blocks(number), lambda region: reader.region(number, region))
        if self._database is not None:
            self._database.maps.add(volume, number)

    def _connect_frames(self, store: FrameStore, number: int) -> None:
        reader = self._reader
        if reader.frames(number) != store.kept:
            raise StateError(f"the state of the run in {reader.path} is damaged: stored frames are missing")
        store.continue_from(lambda n: reader.frame(number, n))
        if self._database is not None:
            self._database.frames.add(store, number)


def _class_name(value: object, place: str) -> str:
    if not schema.is_state_class(type(value)):
        raise StateError(f"{place} is a {schema.name_of(type(value))}, which cannot be stored")
    return schema.name_of(type(value))
