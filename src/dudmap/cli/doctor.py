"""``dudmap doctor``: check the installation."""

import json
from dataclasses import asdict

import typer

from dudmap.app.terminal import plain_console, say
from dudmap.cli import options as o

MARKS = {"good": ("good", "green"), "note": ("note", "yellow"), "bad": ("bad ", "red")}


def doctor(as_json: o.JsonOption = False) -> None:
    """Check the installation and name remedies: versions, processor, threads, GPU, caches, extras, port of the page.

    Ends with 1 if something stops the program. Notes only limit a part of it.
    """
    from rich.text import Text

    from dudmap.app.doctor import checks

    found = list(checks())
    works = all(check.state != "bad" for check in found)
    if as_json:
        say(json.dumps({"works": works, "checks": [asdict(check) for check in found]}))
    else:
        console = plain_console(soft_wrap=True)
        for check in found:
            mark, style = MARKS[check.state]
            console.print(Text.assemble((mark, style), "  ", (check.name, "bold"), ": "), end="")
            console.print(check.found + (f" -> {check.mend}" if check.mend else ""))
        console.print("dudmap works here" if works else "dudmap does not work here until this is corrected")
    if not works:
        raise typer.Exit(1)
