"""Digest of everything that determines the machine code of a kernel."""

import hashlib
import inspect
from collections.abc import Iterator
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import types

LIBRARIES = {"builtins", "llvmlite", "math", "numba", "numpy"}
"""Packages whose functions enter a digest by name."""
PLAIN = (bool, int, float, complex, str, bytes, np.generic, type(None))


def digest(kernel: Any) -> str:  # noqa: ANN401 - a dispatcher of Numba
    """Digest of a kernel: code, options, and all functions and constants that it reads; not comments, docstrings and
    line numbers."""
    return hashlib.sha256("\n".join(sorted(reached(kernel).values())).encode()).hexdigest()


def reached(kernel: Any) -> dict[Any, str]:  # noqa: ANN401
    """A kernel and all functions that it calls, each with its text for the digest."""
    found: dict[Any, str] = {}
    waiting = [kernel]
    while waiting:
        one = waiting.pop()
        if one not in found:
            found[one], called = _read(one)
            waiting.extend(called)
    return found


def layout(type_: Any) -> str:  # noqa: ANN401 - a type of Numba, or several
    """Name of an argument type with the field names of named tuples."""
    parts: Any = type_ if isinstance(type_, tuple | types.BaseTuple) else ()
    if not parts:
        return str(type_)
    name, fields = getattr(type_, "instance_class", ""), getattr(type_, "fields", "")
    return f"{name}{fields}({', '.join(map(layout, parts))})"


@cache
def _read(kernel: Any) -> tuple[str, tuple[Any, ...]]:  # noqa: ANN401
    function, called = inspect.unwrap(kernel), list[Any]()
    code = function.__code__
    read = {name: function.__globals__[name] for name in _names(code) if name in function.__globals__}
    read |= zip(code.co_freevars, (cell.cell_contents for cell in function.__closure__ or ()), strict=True)
    values = [(name, _text(value, called)) for name, value in sorted(read.items())]
    defaults = _text([function.__defaults__, sorted((function.__kwdefaults__ or {}).items())], called)
    return repr((_name(kernel), _code(code, function.__doc__), defaults, values)), tuple(called)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _names(code: CodeType) -> set[str]:
    return {name for one in _codes(code) for name in one.co_names}


def _code(code: CodeType, doc: str | None = None) -> str:
    parts = (_code(one) if isinstance(one, CodeType) else _text(one) for one in code.co_consts if not doc or one != doc)
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    return repr((code.co_code, [*parts], names, code.co_argcount, code.co_kwonlyargcount, code.co_flags))


def _name(function: Any) -> str:  # noqa: ANN401
    options = sorted((key, _text(value)) for key, value in getattr(function, "targetoptions", {}).items())
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", function)  # NumPy 1 has none
    return f"{module}.{name} {options}"


def _text(value: Any, called: list[Any] | None = None) -> str:  # noqa: ANN401
    value = getattr(value, "inlined", value)
    if isinstance(value, PLAIN):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        return f"{type(value).__name__} {[_text(one, called) for one in value]}"
    if isinstance(value, set | frozenset):
        return f"set {sorted(_text(one) for one in value)}"
    if isinstance(value, np.ndarray):
        return f"array {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, types.ExternalFunction):
        return f"external {value.symbol} {value.sig}"
    if isinstance(value, types.Type):
        return f"type {value}"
    if isinstance(value, ModuleType) and value.__name__.partition(".")[0] in LIBRARIES:
        return f"module {value.__name__}"
    if isinstance(value, type):
        return f"class {value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}"
    if not callable(value):
        raise TypeError(f"kernels may read numbers, arrays, tuples and functions; one reads a {type(value).__name__}")
    own = isinstance(value, FunctionType) or hasattr(value, "__wrapped__")  # excludes functions written in C
    if called is not None and own and value.__module__.partition(".")[0] not in LIBRARIES:
        called.append(value)
    return f"function {_name(value)}"
