"""A progress bar for commands that work through frames."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def counted(name: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Bar on stderr, if that is a terminal; gives a function that takes the number of finished frames and of all."""
    from rich.progress import Progress

    from dudmap.app.terminal import plain_console

    console = plain_console(stderr=True)
    with Progress(console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
