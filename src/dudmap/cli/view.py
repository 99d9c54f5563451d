"""``dudmap view``: a run folder in the browser; also the observers of ``dudmap run`` and ``demo``."""

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from dudmap import interruption
from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.errors import DudmapError

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver


def view(
    run: o.RunArgument, host: o.HostOption = "127.0.0.1", port: o.PortOption = 8080, token: o.TokenOption = None
) -> None:
    """Show a run folder in the browser until ctrl-C: map, camera, moving objects, images, plots (extra view)."""
    from dudmap.app.viewing.live_view import open_run

    window = open_run(run, host, port, token)
    say(f"{window.url} shows {run} {window.access.notice}; ctrl-C ends it", err=True)
    _wait()
    window.stop()


@contextmanager
def observers(wanted: o.WatchingOptions) -> "Iterator[tuple[RunObserver, ...]]":
    """Yield the wanted observers of a run. An unforeseen error becomes a sentence and a report; a page stays open until
    ctrl-C on a terminal."""
    from dudmap.app.pipeline.observer import EventLog, report_crash

    events = EventLog(wanted.log)
    with ExitStack() as stack:
        stack.callback(events.close)
        watching: list[RunObserver] = [events]
        if wanted.report:
            from dudmap.app.viewing.report import ReportObserver

            watching.append(ReportObserver())
        if wanted.rerun is not None:
            from dudmap.app.viewing.rerun_log import RerunLog

            watching.append(RerunLog(wanted.rerun))
        if wanted.view:
            from dudmap.app.viewing.live_view import LiveView
            from dudmap.app.viewing.window import Window

            window = Window(wanted.host, wanted.port, "dudmap", wanted.token)
            stack.callback(window.stop)
            live_view = LiveView(window)
            stack.callback(live_view.close)
            watching.append(live_view)
            say(f"{window.url} shows the run {window.access.notice}", err=True)
        try:
            yield tuple(watching)
        except (DudmapError, OSError, MemoryError, typer.Exit):
            raise
        except Exception as error:  # a defect of dudmap
            raise report_crash(error, events.out or Path.cwd(), events.recent) from error
        if wanted.view and sys.stdin.isatty() and not interruption.must_end():
            say("the page stays open; ctrl-C ends it", err=True)
            _wait()


def _wait() -> None:
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return
