"""What commands have in common: the answer on stdout, as text or as JSON, and what the shell completes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from dudmap.app.terminal import say

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object, and nothing else.")]


def answer(tree: Mapping[str, Any], text: str, *, as_json: bool, quiet: bool = False) -> None:
    """Print the result of a command to stdout: as one JSON object, as text, or not at all."""
    if as_json:
        say(json.dumps(plain(tree), allow_nan=False))
    elif not quiet:
        say(text)


def plain(value: Any) -> Any:  # noqa: ANN401 - what JSON holds
    """The value as JSON knows it: arrays are lists, paths are text, numbers that are not finite are null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    return value


def preset_names(incomplete: str) -> list[str]:
    """Presets that begin so, for the shell."""
    from dudmap.presets import PRESETS

    return [name for name in PRESETS if name.startswith(incomplete)]


def parameter_names(incomplete: str) -> list[str]:
    """Parameters that begin so, with the sign that follows, for the shell."""
    from dudmap.config import keys

    return [f"{key}=" for key in keys() if key.startswith(incomplete)]


def camera_names(incomplete: str) -> list[str]:
    """Kinds of cameras that begin so, for the shell."""
    from dudmap.io.cameras import CAMERAS

    return [name for name in CAMERAS if name.startswith(incomplete)]
