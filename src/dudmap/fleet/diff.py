"""``dudmap diff``: changes between two run folders, as JSON, meshes and a page."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import write_text, writing
from dudmap.core.geometry import se3
from dudmap.core.places.saved_map import SavedMap
from dudmap.errors import ConfigError, DudmapError, MapError
from dudmap.fleet.agreement import MIN_AREA, MIN_OVERLAP
from dudmap.fleet.change_evidence import Evidence, Visit
from dudmap.fleet.change_report import change_page, motion_and_confidence, tinted
from dudmap.fleet.changes import Change, find_changes, mesh_of
from dudmap.fleet.map_merging import compare_maps
from dudmap.own_folder import make_folder, remove_files

CHANGES_FILE, REPORT = "changes.json", "report.html"
WRITTEN = {"": r"changes\.json|report\.html", "changes": r"\d+\.ply"}
"""File names of a comparison by sub-folder, regular expressions."""
BEST_FRAMES = 3


def diff_runs(
    before: str | Path, after: str | Path, out: str | Path | None = None, min_size: float = 0.1
) -> dict[str, Any]:
    """Compare two run folders; return the content of changes.json.

    Args:
        before, after: Run folders with map.npz and keyframes.npz.
        out: New folder, or of an earlier comparison, for changes.json, changes/<id>.ply and report.html.
        min_size: Smallest reported thing, metres.

    Raises:
        MapError: An incomplete run folder, a map without free space, or places that cannot be joined.
        ConfigError: ``min_size`` is out of range.
        DudmapError: ``out`` cannot be used.
    """
    found = compared(before, after, min_size)
    tree = found.tree()
    if out is not None:
        _write(Path(out), tree, found)
    return tree


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of two runs.

    Attributes:
        visits: The maps in the first one's world.
    """

    maps: tuple[SavedMap, SavedMap]
    visits: tuple[Visit, Visit]
    changes: list[Change]
    evidence: tuple[Evidence, Evidence]
    alignment: dict[str, Any]
    notes: list[str]
    min_size: float

    def tree(self) -> dict[str, Any]:
        """Content of changes.json."""
        rows = []
        for number, change in enumerate(self.changes, start=1):
            frames = [best_frames(change, saved, visit) for saved, visit in zip(self.maps, self.visits, strict=True)]
            shown = {"frames_before": [t for t, _ in frames[0]], "frames_after": [t for t, _ in frames[1]]}
            rows.append({"id": number} | change.tree() | shown)
        kinds = [change.kind for change in self.changes]
        return {
            "before": str(self.maps[0].folder), "after": str(self.maps[1].folder),
            "T_before_after": self.visits[1].T_common_map.tolist(), "alignment": self.alignment,
            "min_size": self.min_size, "notes": self.notes,
            "counts": {kind: kinds.count(kind) for kind in sorted(set(kinds))}, "changes": rows,
        }  # fmt: skip


def compared(before: str | Path, after: str | Path, min_size: float) -> Comparison:
    """Compare two run folders, see ``diff_runs``."""
    before, after = Path(before), Path(after)
    maps = SavedMap.load(before), SavedMap.load(after)
    coarsest = max(saved.volume.voxel_size for saved in maps)
    if not 2 * coarsest <= min_size <= 10:
        raise ConfigError(f"--min-size is {min_size:g} m; expected {2 * coarsest:g} (two voxels of the maps) to 10 m")
    for saved in maps:
        if not (saved.volume.blocks.free_count[: saved.volume.blocks.num_entries] > 0).any():
            raise MapError(
                f"the map of {saved.folder} holds no free space, so that nothing can be missing or new in it; repeat "
                "the run with volume.carving=true"
            )
    notes = []
    if before.resolve() == after.resolve():
        notes.append("both are the same run: nothing changed")
    pair_tree, T = _aligned(maps, same=bool(notes))
    sizes = [saved.volume.voxel_size for saved in maps]
    if not np.isclose(sizes[0], sizes[1]):
        notes.append(
            f"the maps have voxels of {sizes[0]:g} and {sizes[1]:g} m and were sampled in metres; things below a few "
            f"voxels of {coarsest:g} m are not found"
        )
    visits = Visit.of(maps[0], np.eye(4)), Visit.of(maps[1], T)
    changes, found = find_changes(*visits, min_size)
    return Comparison(maps, visits, changes, found, pair_tree, notes, min_size)


def _aligned(maps: Sequence[SavedMap], *, same: bool) -> tuple[dict[str, Any], NDArray[np.float64]]:
    if same:
        return {"reason": None}, np.eye(4)
    pair = compare_maps(maps[0], maps[1], changed=True)
    if pair.T_a_b is None:
        shared = pair.agreement
        too_small = (
            "" if shared is None or shared.enough else f"; at least {MIN_AREA:g} m2 and {MIN_OVERLAP:.0%} are needed"
        )
        raise MapError(f"{maps[0].folder} and {maps[1].folder} cannot be compared: {pair.reason}{too_small}")
    return pair.tree(), pair.T_a_b


def best_frames(change: Change, saved: SavedMap, visit: Visit) -> list[tuple[float, NDArray[np.float64]]]:
    """Times and poses (4, 4), common frame, of the keyframes that show a change best."""
    camera, box = visit.volume.camera, change.box
    centre, radius = box.mean(axis=0), np.linalg.norm(box[1] - box[0]) / 2
    scores = []
    for T in visit.keyframes:
        local = se3.inverse(T)[:3] @ np.append(centre, 1)
        aside = np.hypot(local[0] / camera.cx * camera.fx, local[1] / camera.cy * camera.fy) / max(local[2], 1e-3)
        scores.append(max(aside, 0.3) + 0.3 * abs(local[2] - max(1.5 * radius, 0.8)) if local[2] > 0.3 else np.inf)
    order = np.argsort(scores, kind="stable")[:BEST_FRAMES]
    return [(saved.keyframes[n].timestamp, visit.keyframes[n]) for n in order if np.isfinite(scores[n])]


def _write(out: Path, tree: dict[str, Any], found: Comparison) -> None:
    if out.exists() and not (out.is_dir() and ((out / CHANGES_FILE).is_file() or not any(out.iterdir()))):
        raise DudmapError(f"{out} exists and holds no comparison of `dudmap diff`; name another folder with --out")
    changes, visits, maps = found.changes, found.visits, found.maps
    with writing(f"the comparison {out}"):
        out.mkdir(parents=True, exist_ok=True)
        remove_files(out, WRITTEN)
        make_folder(out / "changes")
        for number, change in enumerate(changes, start=1):
            mesh_of(change, found.evidence).save(out / "changes" / f"{number}.ply")
        poses = [best_frames(one, maps[1], visits[1]) or best_frames(one, maps[0], visits[0]) for one in changes]
        meshes = [tinted(visit.mesh, changes, side) for side, visit in zip(("before", "after"), visits, strict=True)]
        write_text(out / REPORT, change_page(tree, meshes, visits, [p[0][1] if p else None for p in poses]))
        write_text(out / CHANGES_FILE, json.dumps(tree, indent=1) + "\n")


def summary(tree: dict[str, Any]) -> str:
    """Text summary of the changes."""
    lines = list(tree["notes"])
    for row in tree["changes"]:
        if row["kind"] == "unknown":
            continue
        x, y, z = row["centre"]
        text = f"{row['id']}: {row['kind']} at {x:.2f}, {y:.2f}, {z:.2f} m, {100 * row['volume'] ** (1 / 3):.0f} cm"
        lines.append(text + motion_and_confidence(row))
    counts = {kind: count for kind, count in tree["counts"].items() if kind != "unknown"}
    if not counts and not tree["notes"]:
        lines.append("nothing changed")
    unknown = sum(row["area"] for row in tree["changes"] if row["kind"] == "unknown")
    if unknown:
        lines.append(f"unknown: {unknown:.1f} m2 of surface that only one visit saw")
    return "\n".join(lines)
