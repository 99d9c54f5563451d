"""Shared parts of commands: the answer on stdout, as text or as JSON, and groups of commands."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic_core import to_json
from typer.core import TyperGroup

from dudmap.app.terminal import say


class DefaultGroup(TyperGroup):
    """Command group whose first command is the default: ``dudmap evaluate RUN``."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401 - Typer's own types moved between versions
        """Insert the first command if none is named."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the help of the group and of its first command, whose name is optional."""
        super().format_help(ctx, formatter)
        name, command = next(iter(self.commands.items()))
        command.format_help(command.context_class(command, info_name=name, parent=ctx), formatter)


def answer(tree: Mapping[str, Any], text: str, *, as_json: bool, quiet: bool = False, out: Path | None = None) -> None:
    """Print result and output folder to stdout: JSON, text, or nothing."""
    if out is not None:
        tree, text = {**tree, "out": out}, f"{text}\nwritten to {out}"
    if as_json:
        say(to_json(tree, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode())
    elif not quiet:
        say(text)


def free_folder(wanted: Path) -> Path:
    """The folder if new or empty, else the first such ``<name>-2``, ``<name>-3``, ..."""
    folder, number = wanted, 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    return folder


def print_report(metrics: dict[str, object], out: Path, *, quiet: bool, as_json: bool) -> None:
    """Print the metrics of a run to stdout: JSON, a table, or nothing.

    Raises:
        typer.Exit: The run is of no use; the code is ``USELESS``.
    """
    from dudmap.cli import USELESS, fail

    if as_json:
        answer(metrics, "", as_json=True)
    elif not quiet:
        from dudmap.app.pipeline.progress import outcome, summary
        from dudmap.app.terminal import plain_console

        console = plain_console()
        console.print(summary(metrics))
        console.print(outcome(metrics, out), soft_wrap=True)
    if metrics.get("useless"):
        fail(str(metrics["useless"]), code=USELESS)
