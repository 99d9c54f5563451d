"""The command line: ``dudmap COMMAND``.

A command is the function of its name in ``dudmap.cli.<command>``, or an application ``app`` there, imported when
called. Errors are printed as one sentence. Exit codes: 1 error, 2 wrong usage, 3 useless run, 130 Ctrl-C, 143 SIGTERM,
129 SIGHUP.
"""

import ctypes
import io
import logging
import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from dudmap import interruption
from dudmap.cli.options import arranged, grouped
from dudmap.errors import DudmapError, printable
from dudmap.version import __version__

COMMANDS = {
    "run": "Turn a recording into a trajectory and a clean mesh.",
    "view": "Show a run folder in the browser.",
    "report": "Write one page on a run that opens offline.",
    "merge": "Merge the maps of two or more runs of one place.",
    "diff": "List the changes between two visits to a place.",
    "export": "Write the results of a run for another program.",
    "render": "Render the map along a camera path, as a video or a recording.",
    "clean": "Write a recording without its dynamic objects.",
    "live": "Run on a camera, or on a recording as if it were one.",
    "info": "Describe a recording, and warn of suspected faults in it.",
    "calibrate": "Estimate pose, lens and timing of the colour camera relative to the depth camera.",
    "demo": "Render a short recording with a walking person and run on it.",
    "synth": "Render a synthetic recording with exact ground truth.",
    "evaluate": "Score a trajectory, mesh or masks against the ground truth.",
    "benchmark": "Run a suite of recordings and print one table.",
    "study": "Run a designed experiment over configurations and analyse it.",
    "config": "Print all parameters with their meanings as TOML.",
    "warmup": "Compile all kernels in advance.",
    "doctor": "Check the installation and name remedies.",
}
"""Name and one-line help of every command."""


def application_of(name: str) -> typer.Typer:
    """Application of the command of a name in ``COMMANDS``."""
    module = import_module(f"dudmap.cli.{name}")
    if hasattr(module, "app"):
        return module.app
    application = typer.Typer(add_completion=False)
    application.command()(grouped(getattr(module, name)))
    return application


USELESS = 3
"""Exit code of a complete, useless run."""

_USAGE: type[Exception] = typer.BadParameter.__mro__[2]
"""Base of usage errors, of click or of Typer itself."""


class CommandGroup(TyperGroup):
    """Command group that imports commands when called, and prints errors as one sentence."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401 - Typer's own types moved between versions
        """Replace the placeholder of the called command by the command itself."""
        if args and args[0] in COMMANDS:
            self.commands[args[0]] = arranged(typer.main.get_command(application_of(args[0])))
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run the command; print errors without a traceback."""
        try:
            with interruption.recognised():
                return super().invoke(ctx)
        except DudmapError as error:
            fail(str(error))
        except BrokenPipeError:
            raise
        except OSError as error:
            fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        except MemoryError as error:
            fail(not_enough_memory(error))
        except (typer.Exit, typer.Abort, _USAGE):
            raise
        except Exception as error:  # a defect of dudmap
            if isinstance(error, ImportError) and "failed to map segment" in str(error):
                fail(not_enough_memory(error))
            from dudmap.app.pipeline.observer import report_crash

            fail(str(report_crash(error, Path.cwd())))
        except KeyboardInterrupt as interrupt:
            fail(str(interrupt) or "interrupted", code=130)


def not_enough_memory(error: MemoryError | ImportError) -> str:
    """Sentence on an allocation that failed."""
    return f"there is not enough memory ({str(error) or 'none is left'}); give the process more, or less to do"


def fail(sentence: str, code: int = 1) -> None:
    """Print one sentence to stderr and exit.

    Raises:
        typer.Exit: Always.
    """
    from dudmap.app.terminal import say

    say(f"dudmap: {sentence}", err=True)
    raise typer.Exit(code)


def _placeholder() -> None:
    """Placeholder of a command in the help page; never called."""


M_ARENA_MAX = -8
"""Parameter of ``mallopt`` in glibc's malloc.h: the largest number of heaps."""

app = typer.Typer(
    name="dudmap",
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Dense RGB-D SLAM in dynamic scenes: estimates the camera trajectory and a mesh of the static scene.",
)
for _name, _help in COMMANDS.items():
    app.command(_name, help=_help)(_placeholder)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dudmap {__version__}")
        raise typer.Exit


@app.callback()
def _dudmap(
    version: Annotated[
        bool, Option("--version", help="Print the version.", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    from dudmap.app.terminal import show_log

    show_log()


def main() -> None:
    """Entry point of the program ``dudmap``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or pipe that cannot show a character, as on Windows
    _share_one_heap()
    warnings.showwarning = _show_warning
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # that it keeps its list of fonts in a temporary folder
    interruption.listen()
    try:
        app()
    except SystemExit as end:
        sys.exit(interruption.exit_code(end.code if isinstance(end.code, int) else int(end.code is not None)))


def _show_warning(message: Warning | str, *_: object) -> None:
    logging.getLogger(__name__).warning(printable(message))


def _share_one_heap() -> None:
    """Make all threads allocate from one heap (glibc): otherwise only the allocating thread reuses freed images."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_ARENA_MAX, 1)
