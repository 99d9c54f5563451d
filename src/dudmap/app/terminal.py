"""Print text without interpreting control characters or markup in file names."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    """Console that prints texts as ``printable`` and without markup; only ``rich.text.Text`` has styles."""
    from rich.console import Console  # imported here, because it takes a third of the start time

    class PlainConsole(Console):
        def render_str(self, text: str, **options: Any) -> "Text":  # noqa: ANN401
            options.update(markup=False, emoji=False)
            return super().render_str(lines(text), **options)

    return PlainConsole(markup=False, emoji=False, highlight=False, **options)


@contextmanager
def counted(name: str, *, quiet: bool, console: "Console | None" = None) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on stderr, if it is a terminal; yield a function of the numbers of finished and of all
    frames.

    A spinner and the seconds show activity while kernels compile.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = console or plain_console(stderr=True)
    columns = SpinnerColumn(), TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
