"""Score change detection on random pairs of visits."""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.app.pipeline.run import run
from dudmap.atomic_file import write_text
from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.places.saved_map import SavedMap
from dudmap.errors import ConfigError, DudmapError
from dudmap.fleet.change_evidence import Visit
from dudmap.fleet.changes import Change, vertical
from dudmap.fleet.diff import compared
from dudmap.fleet.map_samples import OBSERVED, UNSEEN
from dudmap.io.sequences import Sequence as Recording
from dudmap.lab.benchmark.measure import save
from dudmap.lab.synthetic.inserted import WithThing
from dudmap.lab.synthetic.recording import SyntheticSequence
from dudmap.lab.synthetic.scene import Primitive
from dudmap.lab.synthetic.visits import THINGS as MAKERS
from dudmap.lab.synthetic.visits import TrueChange, visits

SCENES = {"room": 0.5, "corridor": 0.2, "desk": 0.3}
THINGS = {"box": 0.35, "bin": 0.15, "ball": 0.1, "chair": 0.15, "shelf": 0.08, "poster": 0.1, "door": 0.07}
LARGE = ("chair", "shelf", "door")
ONCE = ("door", "poster")
KINDS = {"moved": 0.45, "appeared": 0.275, "disappeared": 0.275}
PATHS = ("handheld", "pan", "orbit", "dolly")
NONE, PEOPLE, LIGHT = 0.2, 0.2, 0.3
"""Shares of the pairs without change, with people in the second visit, with other light."""
SAME = 0.06
"""Distance of coinciding found and true surface, metres: three voxels and the noise at 3 m."""
SAME_MOTION_CM = 5.0
"""Largest motion error of a thing hardly seen by one visit, cm."""
LEAST_SHARE = 0.5
"""Smallest share of a found surface on a matching true change."""
IOU_CELL = 0.04
"""Cells that compare found and true surface, metres."""
SMALL = 0.15
FRAMES, FPS, SIZE = 60, 12.0, (320, 240)


def draw_pair(seed: int, number: int) -> dict[str, Any]:
    """Arguments of ``visits`` of pair ``number`` of a seed."""
    rng = np.random.default_rng([seed, number, 33])

    def one_of(shares: dict[str, float]) -> str:
        return str(rng.choice(list(shares), p=np.array(list(shares.values())) / sum(shares.values())))

    scene, none = one_of(SCENES), rng.random() < NONE
    changes = []
    for _ in range(int(rng.integers(1, 5))):
        thing, kind = one_of(THINGS), one_of(KINDS)
        while (scene == "desk" and thing in LARGE) or (thing in ONCE and thing in [name for name, _ in changes]):
            thing = one_of(THINGS)
        changes.append((thing, {"poster": "recoloured", "door": "opened"}.get(thing, kind)))
    return {
        "changes": [] if none else changes,
        "scene": scene, "seed": int(rng.integers(1, 100_000)), "paths": tuple(str(x) for x in rng.choice(PATHS, 2)),
        "people": bool(rng.random() < PEOPLE), "other_light": bool(rng.random() < LIGHT),
        "frames": FRAMES, "fps": FPS, "camera": SIZE,
    }  # fmt: skip


def rendered_pair(pair: dict[str, Any]) -> tuple[list[SyntheticSequence], list[TrueChange]]:
    """Recordings and true changes of a pair. The last changes are left out if the room has no place for them."""
    while True:
        try:
            return visits(**pair)
        except ConfigError:
            if not pair["changes"]:
                raise
            pair = pair | {"changes": pair["changes"][:-1]}


def run_pair(recordings: list[SyntheticSequence], config: Config, out: Path, arguments: str = "") -> list[Path]:
    """Run folders of both visits, reused for equal ``arguments``."""
    folders, note = [out / "before", out / "after"], out / "pair.json"
    if note.is_file() and note.read_text(encoding="utf-8") == arguments:
        return folders
    for recording, folder in zip(recordings, folders, strict=True):
        run(recording, config, folder, progress=False)
    write_text(note, arguments)
    return folders


def score_pair(
    changes: Sequence[Change], truth: Sequence[TrueChange], T_scene_before: NDArray[np.float64]
) -> dict[str, Any]:
    """Match found to true changes; return matches with errors, and kinds of false changes.

    ``T_scene_before`` (4, 4) maps found to true frame; true changes of kind "unknown" do not count.
    """

    def surface(one: TrueChange | Change) -> NDArray[np.float64]:
        if isinstance(one, TrueChange):
            return np.concatenate([one.before, one.after])
        parts = [piece.points for piece in (one.before, one.after) if piece is not None]
        return np.concatenate(parts) @ T_scene_before[:3, :3].T + T_scene_before[:3, 3]

    found = [change for change in changes if change.kind != "unknown"]
    trees = [KDTree(surface(one)) if len(surface(one)) else None for one in truth]
    owners: list[int | None] = []
    for change in found:
        shares = [-1.0 if t is None else float(np.mean(t.query(surface(change))[0] < SAME)) for t in trees]
        owners.append(int(np.argmax(shares)) if shares and max(shares) >= LEAST_SHARE else None)
    things: list[dict[str, Any]] = []
    false: list[str] = []
    for number, true in enumerate(truth):
        mine = sorted(
            (c for c, owner in zip(found, owners, strict=True) if owner == number), key=lambda c: -len(c.points)
        )
        if true.kind == "unknown":
            continue
        row: dict[str, Any] = {"thing": true.thing, "kind": true.kind, "size": true.size, "found": None}
        if not true.common and mine and {c.kind for c in mine[:2]} <= {"disappeared", "appeared"}:
            row["kind"] = mine[0].kind  # both visits saw different sides: the identity of the thing is not observable
            mine = mine[:1] + [c for c in mine[1:2] if c.kind == mine[0].kind] + mine[2:]
        false += [c.kind for c in mine[1:]]
        if mine:
            row |= {"found": mine[0].kind, "iou": _iou(surface(mine[0]), surface(true))}
            motion = mine[0].motion
            if motion is not None and not np.array_equal(true.T_after_before, np.eye(4)):
                error = _motion_error(true, T_scene_before @ motion.T_after_before @ se3.inverse(T_scene_before))
                error |= {"sigma_cm": 100 * motion.sigma[0], "sigma_deg": float(np.degrees(motion.sigma[1]))}
                if error["motion_cm"] < SAME_MOTION_CM:  # both visits saw it, though one saw little
                    row["kind"] = "moved"
                row |= {"ambiguous": True} if motion.ambiguous else error
        things.append(row)
    false += [c.kind for c, owner in zip(found, owners, strict=True) if owner is None]
    return {"things": things, "false": false}


def _iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    cells = [{tuple(row) for row in np.floor(points / IOU_CELL).astype(int).tolist()} for points in (a, b)]
    return len(cells[0] & cells[1]) / max(len(cells[0] | cells[1]), 1)


def _motion_error(true: TrueChange, T: NDArray[np.float64]) -> dict[str, float]:
    off = T @ se3.inverse(true.T_after_before)
    at = true.T_after_before[:3] @ np.append(true.at, 1)
    moved = 100 * float(np.linalg.norm(off[:3, :3] @ at + off[:3, 3] - at))
    return {"motion_cm": moved, "motion_deg": 0.0 if true.symmetric else float(np.degrees(se3.rotation_angle(off)))}


def measure_pair(pair: dict[str, Any], config: Config, min_size: float, keep: Path | None = None) -> dict[str, Any]:
    """Render, run and compare one pair; return its row. ``keep``: folder that keeps the runs."""
    recordings, truth = rendered_pair(pair)
    row: dict[str, Any] = {"scene": pair["scene"], "seed": pair["seed"], "people": pair["people"]}
    with tempfile.TemporaryDirectory() as folder:
        arguments = json.dumps(pair | {"config": config.to_toml()}, sort_keys=True)
        folders = run_pair(recordings, config, keep or Path(folder), arguments)
        start = time.perf_counter()
        try:
            changes = compared(folders[0], folders[1], min_size).changes
        except DudmapError as error:
            return row | {"error": str(error), "things": [], "false": []}
        row["seconds"] = round(time.perf_counter() - start, 2)
    return row | score_pair(changes, truth, recordings[0].ground_truth.Ts_world_camera[0])


def measure_insertions(
    recording: Recording, seed: int, count: int, config: Config, min_size: float, done: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """Insert ``count`` things into the second half of a real recording (swapped in every other row); return rows."""
    rng, middle, rows = np.random.default_rng([seed, 35]), len(recording) // 2, []
    halves = range(middle), range(middle, len(recording))
    with tempfile.TemporaryDirectory() as folder:
        plain = [Path(folder) / "before", Path(folder) / "plain"]
        empty = Trajectory(np.empty(0), np.empty((0, 4, 4)))
        for frames, out in zip(halves, plain, strict=True):
            run(WithThing(recording, frames, empty, []), config, out, progress=False)
        trajectory = Trajectory.load(plain[1] / "trajectory.txt")
        visit = Visit.of(SavedMap.load(plain[1]), np.eye(4))
        for number in range(count):
            size = float(rng.uniform(SMALL, 0.3))
            thing = WithThing(recording, halves[1], trajectory, _stood(visit, rng, size))
            after = Path(folder) / "after"
            run(thing, config, after, progress=False)
            points = np.unique(np.concatenate(thing.seen).round(2), axis=0)
            none, kind = np.empty((0, 3)), ("appeared", "disappeared")[number % 2]
            sides = (none, points) if kind == "appeared" else (points, none)
            true = TrueChange("box", kind, size, np.eye(4), *sides, symmetric=False, at=points.mean(axis=0))
            found = compared(*((plain[0], after) if kind == "appeared" else (after, plain[0])), min_size)
            T = se3.inverse(found.visits[1].T_common_map) if kind == "appeared" else np.eye(4)
            rows.append({"pair": number, "scene": recording.name} | score_pair(found.changes, [true], T))
            done(rows[-1])
    return rows


def _stood(visit: Visit, rng: np.random.Generator, size: float) -> list[Primitive]:
    up, mesh, camera = vertical(visit), visit.mesh, visit.volume.camera
    level = np.flatnonzero(mesh.normals @ up > 0.95)
    for vertex in rng.permutation(level)[:5000]:
        at = mesh.vertices[vertex].astype(np.float64)
        local = np.einsum("nij,j->ni", np.linalg.inv(visit.views), np.append(at + up * size / 2, 1))[:, :3]
        pixel = camera.project(local)
        inside = (local[:, 2] > 0.7) & (local[:, 2] < 2.5) & np.all((pixel > 60) & (pixel < (580, 420)), axis=1)
        side = np.cross(up, rng.normal(size=3))
        side /= np.linalg.norm(side)
        T = np.eye(4)
        T[:3] = np.stack([side, np.cross(up, side), up, at], axis=1)
        solids = [solid.moved(T) for solid in MAKERS["box"][0](rng, size)]
        around = rng.uniform(-0.5, 0.5, (300, 3)) * size + at + up * 0.7 * size
        samples = visit.sample(around)
        blocked = (samples.state == OBSERVED) & (samples.sdf < 0.1 * size)
        if inside.mean() > 0.3 and not blocked.any() and np.mean(samples.state != UNSEEN) > 0.7:
            return solids
    raise ConfigError("no level surface in the second half of the recording has room for a box in view")


def measure_changes(
    seed: int,
    count: int,
    config: Config,
    out: Path,
    min_size: float,
    done: Callable[[dict[str, Any]], None],
    recording: Recording | None = None,
    given: dict[str, Any] | None = None,
    keep: Path | None = None,
) -> tuple[list[dict[str, Any]], str]:
    """Measure ``count`` pairs; write changes.md, .csv and .json to ``out``; return the rows and the table.

    Pairs are rendered, or the halves of ``recording`` (``measure_insertions``). ``given`` overrides arguments of
    ``visits``; ``keep``: folder for reuse of runs.
    """
    rows = [] if recording is None else measure_insertions(recording, seed, count, config, min_size, done)
    for number in range(count) if recording is None else ():
        row = {"pair": number} | measure_pair(
            draw_pair(seed, number) | (given or {}), config, min_size, keep and keep / f"{seed}-{number}"
        )
        rows.append(row)
        done(row)
    text = table(rows)
    flat = [row | {"things": json.dumps(row["things"]), "false": " ".join(row["false"])} for row in rows]
    save(flat, text, out, "changes", {"seed": seed, "figures": figures(rows)})
    return rows, text


def figures(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Metrics over all pairs."""
    things = [thing for row in rows for thing in row["things"]]
    large = [thing for thing in things if thing["size"] >= SMALL]
    small = [thing for thing in things if thing["size"] < SMALL]
    hits = [thing for thing in things if thing["found"]]
    false = sum(len(row["false"]) for row in rows)

    motions = [thing for thing in hits if "motion_cm" in thing]

    def is_within(thing: dict[str, Any], cm: float, deg: float) -> bool:
        return thing["motion_cm"] <= cm and thing["motion_deg"] <= deg

    def share(part: float, whole: float) -> float | None:
        return round(part / whole, 4) if whole else None

    def median(key: str) -> float | None:
        values = [thing[key] for thing in hits if key in thing]
        return round(float(np.median(values)), 3) if values else None

    def recall(part: Sequence[dict[str, Any]]) -> float | None:
        return share(sum(thing["found"] is not None for thing in part), len(part))

    out: dict[str, float | None] = {
        "pairs": len(rows), "not_compared": sum("error" in row for row in rows), "things": len(things),
        "recall_15cm": recall(large), "recall_small": recall(small), "precision": share(len(hits), len(hits) + false),
        "kind_right": share(sum(thing["found"] == thing["kind"] for thing in hits), len(hits)),
        "voxel_iou": median("iou"), "motion_cm": median("motion_cm"), "motion_deg": median("motion_deg"),
        "motion_within_1cm_1deg": share(sum(is_within(thing, 1, 1) for thing in motions), len(motions)),
        "motion_within_3_sigma": share(
            sum(is_within(thing, 3 * thing["sigma_cm"], 3 * thing["sigma_deg"]) for thing in motions), len(motions)
        ),
        "motion_ambiguous": sum("ambiguous" in thing for thing in hits),
        "unchanged_pairs": sum(not row["things"] for row in rows),
        "false_in_unchanged": sum(len(row["false"]) for row in rows if not row["things"]),
        "seconds": round(float(np.median([row["seconds"] for row in rows if "seconds" in row] or [0])), 2),
    }  # fmt: skip
    for kind in sorted({thing["kind"] for thing in things}):
        out[f"recall_{kind}"] = recall([thing for thing in things if thing["kind"] == kind])
    return out


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown table of the metrics."""
    lines = [f"| {name} | {'-' if value is None else value} |" for name, value in figures(rows).items()]
    return "\n".join(["| figure | value |", "|---|---:|", *lines])
