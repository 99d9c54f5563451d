"""Print text and log without control characters or markup."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

import typer

from dudmap.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


def say(text: object, *, err: bool = False) -> None:
    """Print a text of one or several lines to stdout, or to stderr."""
    typer.echo(lines(str(text)), err=err)


def lines(text: str) -> str:
    """Apply ``printable`` to every line of a text."""
    return "\n".join(map(printable, text.split("\n")))


def plain_console(**options: Any) -> "Console":  # noqa: ANN401 - those of Console
    """Console for ``printable`` texts without markup, except ``rich.text.Text``."""
    from rich.console import Console  # imported here, because it takes a third of the start time

    class PlainConsole(Console):
        def render_str(self, text: str, **options: Any) -> "Text":  # noqa: ANN401
            options.update(markup=False, emoji=False)
            return super().render_str(lines(text), **options)

    return PlainConsole(markup=False, emoji=False, highlight=False, **options)


@cache
def stderr_console() -> "Console":
    """Console on stderr for progress bars and log messages."""
    return plain_console(stderr=True)


class TerminalHandler(logging.Handler):
    """Prints log messages on stderr; marks warnings."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        try:
            mark, style = ("warning: ", "yellow") if record.levelno >= logging.WARNING else ("", "")
            stderr_console().print(f"{mark}{record.getMessage()}", style=style, soft_wrap=True)
        except Exception:
            self.handleError(record)


def show_log(*, quiet: bool = False, verbose: bool = False) -> None:
    """Print the log ``dudmap`` on stderr: a run's messages, with ``quiet`` warnings, with ``verbose`` all."""
    log, core = logging.getLogger("dudmap"), logging.getLogger("dudmap.core")
    if not any(isinstance(handler, TerminalHandler) for handler in log.handlers):
        log.addHandler(TerminalHandler())
    log.setLevel(logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO)
    core.setLevel(logging.NOTSET if verbose else logging.ERROR)


@contextmanager
def counted(name: str, *, quiet: bool, console: "Console | None" = None) -> Iterator[Callable[[int, int], None]]:
    """Progress bar on a terminal's stderr; yields a function of finished and all frames. A spinner shows activity.

    A spinner and the seconds show activity while kernels compile.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = console or stderr_console()
    columns = SpinnerColumn(), TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
