"""``dudmap doctor``: check the installation."""

from typing import Annotated

import typer

from dudmap.app.terminal import plain_console
from dudmap.cli import options as o
from dudmap.cli.output import answer

app = typer.Typer(add_completion=False)

MARKS = {"good": ("good", "green"), "note": ("note", "yellow"), "bad": ("bad ", "red")}


@app.command()
def doctor(
    as_json: o.JsonOption = False,
    licences: Annotated[
        bool, typer.Option("--licences", "--licenses", help="List the licences of all required packages instead.")
    ] = False,
) -> None:
    """Check the installation and say what to do: versions, processor, threads, GPU, caches, extras, port of the page.

    Ends with 1 if something stops the program. Notes only limit a part of it.
    """
    if licences:
        _print_licences(as_json)
        return
    from rich.text import Text

    from dudmap.app.doctor import checks

    found = list(checks())
    works = all(check.state != "bad" for check in found)
    if as_json:
        answer({"works": works, "checks": [check.tree() for check in found]}, "", as_json=True)
    else:
        console = plain_console(soft_wrap=True)
        for check in found:
            mark, style = MARKS[check.state]
            console.print(Text.assemble((mark, style), "  ", (check.name, "bold"), ": "), end="")
            console.print(check.found + (f" -> {check.mend}" if check.mend else ""))
        console.print("dudmap works here" if works else "dudmap does not work here before this is mended")
    if not works:
        raise typer.Exit(1)


def _print_licences(as_json: bool) -> None:
    from dudmap.app.doctor import licences

    rows = licences()
    tree = [{"package": row.package, "version": row.version, "licence": row.licence} for row in rows]
    text = "\n".join(f"{row.package:<24} {row.version:<12} {row.licence}" for row in rows)
    answer(tree, text, as_json=as_json)
