"""``dudmap benchmark changes``: how many changes between two visits are found."""

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from dudmap.app.terminal import say
from dudmap.cli import options as o
from dudmap.cli.benchmark_machine import RUNS
from dudmap.cli.output import answer


def changes(
    count: Annotated[int, Option(min=1, help="Number of pairs.")] = 20,
    seed: Annotated[int, Option(min=0, help="Seed of the pairs.", metavar="N")] = 0,
    min_size: Annotated[float, Option(help="Edge of the smallest thing that is reported.", metavar="M")] = 0.1,
    out: Annotated[Path, Option(help="Output folder for changes.md, .csv and .json.")] = RUNS / "changes",
    into: Annotated[
        Path | None,
        Option(help="Insert and remove things in the second half of a real recording.", metavar="PATH"),
    ] = None,
    changes: Annotated[
        str | None,
        Option(help="Changes of each pair, as for `synth`; none: nothing changed.", metavar="THING:KIND,..."),
    ] = None,
    edge: Annotated[float | None, Option(help="Longest edge of boxes, balls and bins.", metavar="M")] = None,
    keep_runs: Annotated[
        Path | None, Option(help="Keep the run folders of rendered pairs here, and reuse them.", metavar="FOLDER")
    ] = None,
    assignments: o.SetOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Render pairs of visits with known changes, run on both, and measure how many `dudmap diff` finds.

    A fifth of the pairs has no change, a fifth people in the second visit, and every third other light.
    """
    from dudmap.fleet.change_benchmark import figures, measure_changes
    from dudmap.io.sequences import open_sequence
    from dudmap.lab.synthetic.visits import parsed_changes

    def announce(row: dict[str, Any]) -> None:
        hits = sum(thing["found"] is not None for thing in row["things"])
        outcome = row.get("error") or f"{hits} of {len(row['things'])} found, {len(row['false'])} false"
        say(f"pair {row['pair']}, {row['scene']}: {outcome}", err=True)

    recording = None if into is None else open_sequence(into)
    given: dict[str, Any] = {} if changes is None else {"changes": parsed_changes(changes)}
    given |= {} if edge is None else {"size": edge}
    config = o.read_config(None, None, assignments)
    rows, text = measure_changes(seed, count, config, out, min_size, announce, recording, given, keep_runs)
    tree = {"rows": rows, "figures": figures(rows), "out": out}
    answer(tree, f"{text}\nwritten to {out}", as_json=as_json)
