"""Random worlds with random sensors: failures, reported and silent."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.config import Config
from dudmap.evaluation.tables import grid
from dudmap.lab.benchmark.measure import Row, code_hash, measure_each, measure_sequence
from dudmap.lab.benchmark.suites import Entry
from dudmap.lab.data import tables

SILENT_ATE, SILENT_LOST = 0.05, 0.2
"""A silent failure: ATE RMSE above SILENT_ATE metres, less than SILENT_LOST of the frames lost."""
NAMED, FAULTY, BLURRED = 0.4, 0.3, 0.3
"""Probability of a named camera, of each other fault, and of motion blur."""
DRAWN = tables("benchmark/random_worlds.toml")


def _drawn(fault: str, rng: np.random.Generator) -> Any:  # noqa: ANN401 - a number or a tuple of numbers
    low, high = DRAWN["faults"][fault]
    return float(rng.integers(low, high)) if fault == "jpeg_quality" else _rounded(rng.uniform(low, high))


def _rounded(value: Any) -> Any:  # noqa: ANN401 - a number or a tuple of numbers
    return tuple(round(float(x), 4) for x in value) if np.ndim(value) else round(float(value), 4)


def draw_world(seed: int, number: int) -> dict[str, Any]:
    """Arguments of ``dudmap.lab.synthetic.sequence`` of world ``number`` of a seed."""
    rng = np.random.default_rng([seed, number])

    def one_of(kind: str) -> str:
        shares = DRAWN[kind]
        return str(rng.choice(list(shares), p=np.array(list(shares.values())) / sum(shares.values())))

    scene, content = one_of("scenes"), one_of("contents")
    world: dict[str, Any] = {
        "scene": scene,
        "camera_path": one_of("paths"),
        "camera": DRAWN["sizes"][rng.integers(len(DRAWN["sizes"]))],
        "frames": int(rng.integers(90, 121)),
        "seed": int(rng.integers(1, 100_000)),
    }
    if content == "crowd" and scene in DRAWN["crowded"]:
        world["coverage"] = _rounded(rng.uniform(0.05, 0.5))
    elif content == "situation":
        world["situation"] = str(rng.choice(DRAWN["situations"]))
        if world["situation"] == "follow":
            world["camera_path"] = "follow"
    else:
        count = {"nothing": 0, "one": 1}.get(content, 2)
        world["movers"] = tuple(str(name) for name in rng.choice(DRAWN["movers"], count, replace=False))
    if content != "nothing":
        world["start_dynamic"] = bool(rng.random() < 0.3)
        if rng.random() < 0.4:
            world["speed"] = _rounded(np.exp(rng.uniform(np.log(0.05), np.log(2.0))))
    if rng.random() < NAMED:
        return world | {"sensor": str(rng.choice(DRAWN["sensors"]))}
    faults = {name: _drawn(name, rng) for name in DRAWN["faults"] if rng.random() < FAULTY}
    blur = _rounded(rng.uniform(0.1, 0.6)) if rng.random() < BLURRED else 0.0
    return world | {"noise": str(rng.choice(DRAWN["noises"])), "faults": faults, "motion_blur": blur}


def measure_worlds(
    seed: int,
    numbers: Iterable[int],
    config: Config,
    out: Path,
    workers: int = 1,
    done: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """One row per world, in order; ``done`` receives each row.

    Rows are written at once to seed-<seed>-<fingerprint>.jsonl in ``out``; those of the same code and configuration are
    reused.
    """
    out.mkdir(parents=True, exist_ok=True)
    fingerprint = hashlib.sha256(f"{code_hash()}{config.to_toml()}".encode()).hexdigest()[:8]
    jobs = []
    for number in dict.fromkeys(numbers):
        world = draw_world(seed, number)
        label = {"seed": seed, "world": number, "parameters": world}
        jobs.append((label, (Entry(f"world-{number}", parameters=world), config)))
    return measure_each(_measure, jobs, workers, done, out / f"seed-{seed}-{fingerprint}.jsonl")


def _measure(job: tuple[Entry, Config]) -> Row:
    return measure_sequence(job[0].open(), job[1], None, calibrate=True)


def is_silent_failure(row: Row) -> bool:
    """Whether a world failed silently."""
    ate = row.get("ate_rmse_m")
    return ate is not None and ate > SILENT_ATE and row["lost"] < SILENT_LOST * row["frames"]


def report(rows: list[Row], seed: int) -> str:
    """Markdown: distribution of the ATE, silent failures, worst worlds."""
    measured = [row for row in rows if row.get("ate_rmse_m") is not None]
    measured.sort(key=lambda row: -row["ate_rmse_m"])
    failed = [row for row in rows if row.get("ate_rmse_m") is None]
    silent = [row for row in measured if is_silent_failure(row)]
    text = f"{len(rows)} random worlds of seed {seed}\n\n"
    if measured:
        ates = 1000 * np.array([row["ate_rmse_m"] for row in measured])
        count, frames = (sum(row[key] for row in measured) for key in ("lost", "frames"))
        lost = f"{count} of {frames} in {sum(row['lost'] > 0 for row in measured)} worlds"
        figures = [f"{value:.1f}" for value in (np.median(ates), np.percentile(ates, 95), ates.max())]
        header = ["median ATE, mm", "95 % ATE, mm", "largest ATE, mm", "frames lost", "silent failures", "no result"]
        text += grid(header, [[*figures, lost, str(len(silent)), str(len(failed))]], words=0)
    else:
        text += "No world gave a result.\n"
    text += _listed("Silent failures (ATE > 50 mm, less than 20 % of the frames lost)", silent)
    return text + _listed("Worst worlds", measured[:10]) + _listed("Worlds without a result", failed)


def _listed(title: str, rows: list[Row]) -> str:
    if not rows:
        return f"\n{title}: none.\n"
    text = f"\n{title}:\n"
    for row in rows:
        figure = row.get("error") or "no error could be computed"
        if row.get("ate_rmse_m") is not None:
            figure = f"{1000 * row['ate_rmse_m']:.1f} mm, {row['lost']} of {row['frames']} frames lost"
        again = f"dudmap benchmark random --seed {row['seed']} --only {row['world']}"
        text += f"\n- world {row['world']}: {figure}\n  - `{again}`\n  - {row['parameters']}\n"
    return text
