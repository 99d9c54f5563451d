"""Accuracy gate: on a small fixed set of recordings no figure may be worse than the recorded one plus a margin."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dudmap.config import Config
from dudmap.errors import ConfigError
from dudmap.lab.benchmark.entries import Entry
from dudmap.lab.benchmark.measure import Row, measure_sequence
from dudmap.lab.benchmark.table import grid

SMALL = (320, 240)
WORLDS: dict[str, dict[str, Any]] = {
    "room-people-at-start": {"frames": 40, "situation": "people_at_start"},
    "room-crowd": {"frames": 64, "coverage": 0.35},
    "desk-fast-camera": {"frames": 40, "scene": "desk", "movers": (), "camera_path": "fast"},
    "colour-faults": {
        "frames": 60,
        "movers": (),
        "faults": {
            "color_translation": (0.025, 0.0, 0.0),
            "color_focal_ratio": 0.95,
            "color_delay": 0.025,
            "color_readout": 0.025,
        },
    },
    "kinect-v1": {"frames": 40, "situation": "people_at_start", "sensor": "kinect_v1"},
}
SAMPLES = 100_000
"""Points sampled on each surface; shares then vary by at most 0.03 %, a third of the smallest margin."""
EXCERPT = "freiburg1_xyz"
"""Twelve real frames among the test fixtures."""
FIGURES: dict[str, tuple[str, float, float]] = {
    "lost": ("<=", 0.0, 0.0),
    "ate_rmse_m": ("<=", 0.15, 0.001),
    "rotation_rmse_deg": ("<=", 0.15, 0.02),
    "mask_iou_mean": (">=", 0.0, 0.03),
    "mesh_accuracy_m": ("<=", 0.10, 0.0003),
    "mesh_completeness": (">=", 0.0, 0.01),
    "ghost_area_m2": ("<=", 0.20, 0.02),
}
"""Recorded figures: whether smaller or larger is better, and the margins of a new file, relative and absolute."""


def gate_entries(fixtures: Path) -> list[Entry]:
    """Recordings of the gate.

    Args:
        fixtures: Folder that contains the real excerpt.
    """
    worlds = [Entry(name, parameters={**parameters, "camera": SMALL}) for name, parameters in WORLDS.items()]
    return [*worlds, Entry(EXCERPT, fixtures / EXCERPT)]


@dataclass(frozen=True)
class Check:
    """Comparison of one figure with its recorded value.

    Attributes:
        sequence: Name of the recording.
        figure: Key of the figure.
        recorded: Recorded value.
        bound: Worst value that passes.
        measured: Measured value, None if there is none.
    """

    sequence: str
    figure: str
    recorded: float
    bound: float
    measured: float | None

    @property
    def passed(self) -> bool:
        """Whether the measured value is no worse than the bound."""
        if self.measured is None:
            return False
        return self.measured <= self.bound if FIGURES[self.figure][0] == "<=" else self.measured >= self.bound


def measure_gate(entries: list[Entry], config: Config) -> list[Row]:
    """Figures of every recording, measured in this process."""
    rows = []
    for entry in entries:
        sequence = entry.open()
        row = measure_sequence(sequence, config, entry.surfaces(sequence), samples=SAMPLES)
        rows.append({"sequence": entry.name} | row)
    return rows


def compare(rows: list[Row], recorded: Mapping[str, Any]) -> list[Check]:
    """Compare every recorded figure of the measured recordings with its measured value.

    Raises:
        ConfigError: A recording or a margin is missing in the file.
    """
    checks = []
    for row in rows:
        name = row["sequence"]
        if name not in recorded["figures"]:
            raise ConfigError(f"the gate has no recorded figures of {name}; record them with --record")
        for figure, value in recorded["figures"][name].items():
            if figure not in FIGURES or figure not in recorded["margins"]:
                raise ConfigError(f"unknown figure or margin {figure!r} of the gate; known are {', '.join(FIGURES)}")
            margin = recorded["margins"][figure]
            slack = margin["relative"] * abs(value) + margin["absolute"]
            bound = value + slack if FIGURES[figure][0] == "<=" else value - slack
            checks.append(Check(name, figure, value, bound, row.get(figure)))
    return checks


def load_figures(path: Path) -> dict[str, Any]:
    """Content of the file: ``margins`` by figure, and ``figures`` by recording and figure.

    Raises:
        ConfigError: The file is missing or malformed.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"cannot read the figures of the gate {path}: {error}; --record creates the file") from error
    if not {"margins", "figures"} <= set(content):
        raise ConfigError(f"{path} has no [margins] or no [figures]; --record creates it")
    return content


def save_figures(path: Path, rows: list[Row], margins: Mapping[str, Any] | None = None) -> None:
    """Write the measured figures as the recorded ones; given margins replace the default ones."""
    lines = [
        "# Recorded figures of the accuracy gate; written by `dudmap benchmark gate --record`, reviewed by a person.",
        "# A figure may become worse by relative * recorded + absolute.",
        "",
        "[margins]",
    ]
    default = {figure: {"relative": relative, "absolute": part} for figure, (_, relative, part) in FIGURES.items()}
    for figure, margin in {**default, **(margins or {})}.items():
        lines.append(f"{figure} = {{ relative = {margin['relative']}, absolute = {margin['absolute']} }}")
    for row in rows:
        lines += ["", f"[figures.{row['sequence']}]"]
        lines += [f"{figure} = {round(row[figure], 6)}" for figure in FIGURES if row.get(figure) is not None]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def verdict(checks: list[Check]) -> str:
    """The checks as a Markdown table."""
    rows = [
        [
            check.sequence,
            check.figure,
            f"{check.recorded:.5g}",
            f"{FIGURES[check.figure][0]} {check.bound:.5g}",
            "none" if check.measured is None else f"{check.measured:.5g}",
            "yes" if check.passed else "NO",
        ]
        for check in checks
    ]
    return grid(["sequence", "figure", "recorded", "allowed", "measured", "passed"], rows)
