"""Accuracy gate: no metric may be worse than recorded plus a margin. Missing ones raise a ``ConfigError``."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.evaluation.tables import grid
from dudmap.lab.benchmark.measure import Row, measure_sequence
from dudmap.lab.benchmark.suites import WORLDS, Entry

EXCERPT = "freiburg1_xyz"
"""Twelve real frames of the test fixtures."""
FIGURES: dict[str, tuple[str, float, float]] = {
    "lost": ("<=", 0.0, 0.0),
    "ate_rmse_m": ("<=", 0.15, 0.001),
    "rotation_rmse_deg": ("<=", 0.15, 0.02),
    "mask_iou_mean": (">=", 0.0, 0.03),
    "mesh_accuracy_m": ("<=", 0.10, 0.0003),
    "mesh_completeness": (">=", 0.0, 0.01),
    "ghost_area_m2": ("<=", 0.20, 0.02),
}
"""Recorded metrics: better direction, default margins, relative and absolute."""
HEAD = """\
# Recorded figures of the accuracy gate; written by `dudmap benchmark gate --update`, reviewed by a person.
# A figure may become worse by relative * recorded + absolute.

"""


def gate_entries(fixtures: Path) -> list[Entry]:
    """Recordings of the gate, with the real excerpt of the fixtures."""
    worlds = [Entry(name, parameters=parameters) for name, parameters in WORLDS["gate"].items()]
    return [*worlds, Entry(EXCERPT, fixtures / EXCERPT)]


def measure_gate(entries: list[Entry], config: Config) -> list[Row]:
    """Metrics of every recording."""
    rows = []
    for entry in entries:
        sequence = entry.open()
        row = measure_sequence(sequence, config, entry.surfaces(sequence))
        rows.append({"sequence": entry.name} | row)
    return rows


def compare(rows: list[Row], recorded: Mapping[str, Any]) -> list[Row]:
    """Compare recorded with measured metrics.

    Returns:
        ``sequence``, ``figure``, ``recorded``, ``bound`` (worst passing), ``measured``, ``passed``.
    """
    checks = []
    for row in rows:
        name = row["sequence"]
        if name not in recorded["figures"]:
            raise ConfigError(f"the gate has no recorded figures of {name}; record them with --update")
        for figure, value in recorded["figures"][name].items():
            if figure not in FIGURES or figure not in recorded["margins"]:
                raise ConfigError(f"unknown figure or margin {figure!r} of the gate; known are {', '.join(FIGURES)}")
            margin, measured = recorded["margins"][figure], row.get(figure)
            sign = 1 if FIGURES[figure][0] == "<=" else -1
            bound = value + sign * (margin["relative"] * abs(value) + margin["absolute"])
            passed = measured is not None and sign * measured <= sign * bound
            checks.append({"sequence": name, "figure": figure, "recorded": value, "bound": bound, "measured": measured,
                           "passed": passed})  # fmt: skip
    return checks


def load_figures(path: Path) -> dict[str, Any]:
    """Content of the file: ``margins`` by metric, and ``figures`` by recording and metric."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"cannot read the figures of the gate {path}: {error}; --update creates the file") from error
    if not {"margins", "figures"} <= set(content):
        raise ConfigError(f"{path} has no [margins] or no [figures]; --update creates it")
    return content


def save_figures(path: Path, rows: list[Row], margins: Mapping[str, Any] | None = None) -> None:
    """Write measured as recorded metrics; given margins replace the defaults."""
    default = {figure: {"relative": relative, "absolute": part} for figure, (_, relative, part) in FIGURES.items()}
    figures = {
        row["sequence"]: {key: round(row[key], 6) for key in FIGURES if row.get(key) is not None} for row in rows
    }
    text = tomli_w.dumps({"margins": {**default, **(margins or {})}, "figures": figures})
    path.write_text(HEAD + text, encoding="utf-8")


def verdict(checks: list[Row]) -> str:
    """Markdown table of the checks."""
    rows = []
    for check in checks:
        allowed, measured = f"{FIGURES[check['figure']][0]} {check['bound']:.5g}", check["measured"]
        found = "none" if measured is None else f"{measured:.5g}", "yes" if check["passed"] else "NO"
        rows.append([check["sequence"], check["figure"], f"{check['recorded']:.5g}", allowed, *found])
    return grid(["sequence", "figure", "recorded", "allowed", "measured", "passed"], rows)
