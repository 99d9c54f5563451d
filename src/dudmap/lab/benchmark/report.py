"""Report of a suite: measured, other systems' and published metrics."""

import math
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

from dudmap.app.pipeline.environment import machine, versions
from dudmap.config import Config
from dudmap.errors import ConfigError, DudmapError
from dudmap.evaluation.tables import grid, shown
from dudmap.evaluation.trajectory import accuracy
from dudmap.lab.benchmark.limits import limits_table
from dudmap.lab.benchmark.measure import COLUMNS, SCORED, Job, Row, markdown, measure_all, save, score_mesh
from dudmap.lab.benchmark.suites import UNCALIBRATED, Entry, Suite
from dudmap.lab.data import tables


class Published(NamedTuple):
    """One published metric: recording, system, key, value in unit (m, m/s, deg/s), publication."""

    sequence: str
    system: str
    metric: str
    value: float
    source: str


def published(sequences: Collection[str] | None = None) -> list[Published]:
    """Published metrics (``published.toml``) of all or given recordings."""
    content = tables("benchmark/published.toml")
    sources = content["sources"]
    return [
        Published(sequence, row["system"], table["metric"], round(value * table["factor"], 7), sources[row["source"]])
        for table in content["table"]
        for row in table["rows"]
        for sequence, value in zip(table["sequences"], row["values"], strict=True)
        if not math.isnan(value) and (sequences is None or sequence in sequences)
    ]


def run_suite(
    suite: Suite,
    systems: Mapping[str, Config],
    others: Mapping[str, Path],
    out: Path,
    *,
    workers: int = 1,
    done: Callable[[Row], None] = lambda row: None,
) -> tuple[Row, str]:
    """Measure a suite; write <suite>.md, .csv and .json into ``out``; return JSON content and Markdown.

    Runs stay in ``out``/runs/<system>/<sequence>, except ``limits``. ``others``: folders of other systems,
    FOLDER/<sequence>/trajectory.txt and mesh.ply.
    """
    kept = None if suite.name == "limits" else out / "runs"
    jobs = [
        Job(entry, name, config, kept and kept / name / entry.name, name not in UNCALIBRATED)
        for entry in suite.entries
        for name, config in systems.items()
    ]
    rows = measure_all(jobs, workers, done)
    for name, folder in others.items():
        for entry in suite.entries:
            rows.append({"sequence": entry.name, "system": name} | _scored(entry, folder / entry.name))
            done(rows[-1])
    order = {entry.name: number for number, entry in enumerate(suite.entries)}
    rows.sort(key=lambda row: order[row["sequence"]])
    printed = published(suite.names())
    table = markdown(rows) if rows else "None of its recordings was found.\n"
    text = f"# Suite {suite.name}\n\n{table}\n{_missing(suite)}{comparison_tables(rows, printed, suite)}"
    text += limits_table(rows, [*systems, *others]) if suite.name == "limits" else ""
    if workers > 1:
        text += f"\n{workers} runs at a time: the times per frame are not of an otherwise idle machine.\n"
    cpu = machine()
    text += f"\n{cpu['cpu']}, {cpu['cores_usable']} cores; dudmap {versions()['dudmap']}\n"
    more = {
        "suite": suite.name,
        "missing": {entry.name: entry.address for entry in suite.missing},
        "published": [value._asdict() for value in printed],
    }
    return save(rows, text, out, suite.name, more), text


def named_folders(assignments: list[str]) -> dict[str, Path]:
    """Parse ``NAME=FOLDER`` pairs."""
    found = {}
    for assignment in assignments:
        name, equals, folder = assignment.partition("=")
        if not name or not equals or not Path(folder).is_dir():
            raise ConfigError(
                f"cannot score {assignment!r}; expected NAME=FOLDER, where FOLDER holds <sequence>/trajectory.txt"
            )
        found[name] = Path(folder)
    return found


def _scored(entry: Entry, folder: Path) -> Row:
    from dudmap.core.geometry.mesh import Mesh
    from dudmap.core.geometry.trajectory import Trajectory

    path = folder / "trajectory.txt"
    if not path.is_file():
        return {"error": f"{path} does not exist"}
    try:
        sequence = entry.open()
        if sequence.ground_truth is None:
            return {"error": f"{entry.name} has no ground truth to score against"}
        estimate = Trajectory.load(path)
        row: Row = {"frames": len(sequence), "lost": max(len(sequence) - len(estimate), 0)}
        row |= accuracy(estimate, sequence.ground_truth, SCORED)
        surfaces = entry.surfaces(sequence)
        if surfaces is not None and (folder / "mesh.ply").is_file():
            mesh = Mesh.load(folder / "mesh.ply")
            row |= score_mesh(mesh, estimate, sequence.ground_truth, *surfaces)
    except DudmapError as error:
        return {"error": str(error)}
    return row


def _missing(suite: Suite) -> str:
    if not suite.missing:
        return ""
    lines = [f"- {entry.name}: {entry.address}" for entry in suite.missing]
    return "Not found and skipped; they can be downloaded from these addresses:\n\n" + "\n".join(lines) + "\n"


def comparison_tables(rows: list[Row], printed: list[Published], suite: Suite) -> str:
    """Markdown table per published metric: measured systems bold, then published ones."""
    text, sources = "", list(dict.fromkeys(value.source for value in printed))
    for column in COLUMNS:
        values = [value for value in printed if value.metric == column.key]
        if not values:
            continue
        known = {value.sequence for value in values}
        names = [name for name in suite.names() if name in known]
        lines: dict[tuple[str, str], dict[str, str]] = {}
        for row in rows:
            if row["sequence"] in known and row.get(column.key) is not None:
                line = lines.setdefault((f"**{row['system']}**", "measured here"), {})
                line[row["sequence"]] = shown(row[column.key], column)
        for value in values:
            line = lines.setdefault((value.system, f"[{sources.index(value.source) + 1}]"), {})
            line[value.sequence] = shown(value.value, column)
        body = [[*who, *(line.get(name, "") for name in names)] for who, line in lines.items()]
        text += f"\n## {column.heading}\n\n{grid(['system', 'source', *names], body)}"
    if text:
        text += "\nSources:\n\n" + "\n".join(f"{number}. {source}" for number, source in enumerate(sources, 1)) + "\n"
    return text
