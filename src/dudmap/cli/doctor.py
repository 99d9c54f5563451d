"""``dudmap doctor``: check the installation."""

import json
from typing import Annotated

import typer

app = typer.Typer(add_completion=False)

MARKS = {"good": "[green]good[/]", "note": "[yellow]note[/]", "bad": "[red]bad [/]"}


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a list.")] = False,
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
    from rich.console import Console

    from dudmap.doctor import checks

    found = list(checks())
    works = all(check.state != "bad" for check in found)
    if as_json:
        typer.echo(json.dumps({"works": works, "checks": [check.tree() for check in found]}))
    else:
        console = Console(soft_wrap=True, highlight=False)
        for check in found:
            console.print(f"{MARKS[check.state]}  [bold]{check.name}[/]: ", end="")
            console.print(check.found + (f" -> {check.mend}" if check.mend else ""), markup=False)
        console.print("dudmap works here" if works else "dudmap does not work here before this is mended")
    if not works:
        raise typer.Exit(1)


def _print_licences(as_json: bool) -> None:
    from dudmap.doctor import licences

    rows = licences()
    if as_json:
        typer.echo(json.dumps([{"package": r.package, "version": r.version, "licence": r.licence} for r in rows]))
        return
    for row in rows:
        typer.echo(f"{row.package:<24} {row.version:<12} {row.licence}")
