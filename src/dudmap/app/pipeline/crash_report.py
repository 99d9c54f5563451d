"""What is left when dudmap itself fails: a file that says with which versions, where, and in which frames."""

import json
import platform
import re
import sys
import time
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dudmap.atomic_file import write_bytes
from dudmap.errors import InternalError


def report_crash(error: BaseException, folder: Path, events: Iterable[dict[str, Any]] = ()) -> InternalError:
    """Write ``crash-<date>.txt`` and return the error that says so in one sentence.

    Args:
        error: What was raised.
        folder: Where to write it.
        events: The last events of the run, as ``EventLog`` keeps them.
    """
    path = folder / f"crash-{time.strftime('%Y%m%d-%H%M%S')}.txt"
    what = f"{type(error).__name__}: {error}"
    try:
        write_bytes(path, report_text(error, events).encode("utf-8", "backslashreplace"))
        where = f"{path} says where; please report it with this file"
    except OSError as problem:
        where = f"no report could be written ({problem}); please repeat it with another folder and report it"
    return InternalError(f"this is a defect of dudmap, not of your data or settings ({what}); {where}")


def report_text(error: BaseException, events: Iterable[dict[str, Any]]) -> str:
    """Content of the report."""
    command = re.sub(r"(--token[= ])\S+", r"\1...", " ".join(sys.argv))
    parts = [
        f"dudmap stopped by a defect of its own, {time.strftime('%Y-%m-%d %H:%M:%S %z')}",
        f"command: {command}",
        f"versions: {json.dumps(_versions())}",
        "".join(traceback.format_exception(error)),
        "last events of the run, newest at the end:",
        *(json.dumps(event) for event in events),
    ]
    return "\n".join(parts) + "\n"


def _versions() -> dict[str, Any]:
    """Versions and machine; less where the installation itself is broken."""
    from dudmap.app.pipeline.environment import machine, versions

    try:
        return versions() | machine()
    except (ImportError, OSError) as error:
        return {"python": platform.python_version(), "os": platform.platform(), "missing": str(error)}
