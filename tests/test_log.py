"""The log "dudmap": what a system says of its frames, and the terminal as one handler of it."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from dudmap import Frame, Slam
from dudmap.app.terminal import TerminalHandler, show_log
from dudmap.core.frame_log import log_changes
from wavy_wall import CAMERA, wall


@pytest.fixture(autouse=True)
def terminal():
    """Levels and handlers of the log, which are put back; a command in another test may have changed them."""
    logs = [logging.getLogger(name) for name in ("dudmap", "dudmap.core")]
    for log in logs:
        log.setLevel(logging.NOTSET)
    before = [(log, log.level, [*log.handlers]) for log in logs]
    yield
    for log, level, handlers in before:
        log.setLevel(level)
        log.handlers[:] = handlers


def test_a_system_says_once_that_it_is_lost(caplog):
    slam = Slam(CAMERA)
    for number in range(5):
        frame = wall(1.5, seed=number)
        depth = np.zeros_like(frame.depth) if number > 2 else frame.depth
        state = slam.process(Frame(number / 30, depth, frame.color)).status
    assert state == "lost"
    assert [record.levelname for record in caplog.records if record.name.startswith("dudmap")] == ["WARNING"]
    assert caplog.messages[-1].startswith("0.100 s: lost, ")


def result(time, status="tracked", *, reason="", events=(), submap=0):
    verdict = SimpleNamespace(reason=reason)
    return SimpleNamespace(timestamp=time, status=status, verdict=verdict, events=events, submap=submap)


@pytest.mark.parametrize(
    ("frame", "was", "said"),
    [
        ({}, "tracked", []),
        ({}, "lost", ["2.000 s: tracked again"]),
        ({"events": ["relocalized"]}, "lost", ["2.000 s: tracked again at a known place of map 1"]),
        ({"submap": 1, "events": ["started"]}, "lost", ["2.000 s: map 2 begins"]),
        ({"events": ["corrected"]}, "tracked", ["2.000 s: a loop is closed"]),
        ({"events": ["started", "corrected"]}, "tracked", ["2.000 s: the young map is begun again"]),
        ({"status": "lost", "reason": "why"}, "tracked", ["2.000 s: lost, why"]),
        ({"status": "lost", "reason": "why"}, "lost", []),
        ({"status": "rejected", "reason": "old"}, "lost", ["2.000 s: frame ignored, old"]),
    ],
)
def test_what_changes_is_said(frame, was, said, caplog):
    caplog.set_level(logging.INFO, "dudmap")
    log_changes(result(1.0, was), result(2.0, **frame))
    assert caplog.messages == said


@pytest.mark.parametrize(
    ("manner", "shown"),
    [({}, ["info", "warning: warned"]), ({"quiet": True}, ["warning: warned"]),
     ({"verbose": True}, ["debug", "info", "warning: warned", "warning: of the core"])],
)  # fmt: skip
def test_the_terminal_shows_a_run_and_verbose_all(manner, shown, terminal, capsys):
    show_log(**manner)
    show_log(**manner)  # a second command of the process adds no second handler
    log = logging.getLogger("dudmap.app.pipeline.run")
    log.debug("debug")
    log.info("info")
    log.warning("warned")
    logging.getLogger("dudmap.core.frame_log").warning("of the core")
    assert capsys.readouterr().err.splitlines() == shown
    assert sum(isinstance(handler, TerminalHandler) for handler in logging.getLogger("dudmap").handlers) == 1


def test_control_characters_do_not_reach_the_terminal(terminal, capsys):
    show_log()
    logging.getLogger("dudmap").warning("a \x1b[31mred\x1b[0m [bold]name[/bold]")
    assert capsys.readouterr().err == "warning: a \\x1b[31mred\\x1b[0m [bold]name[/bold]\n"
