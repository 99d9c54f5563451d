"""Merging of many run folders into worlds: maps by range, tiles, trajectories, and a report."""

import json
import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import atomic_file
from dudmap.core.map import morton
from dudmap.core.map.volume import TsdfVolume
from dudmap.errors import DudmapError, MapError
from dudmap.extras import need
from dudmap.fleet.block_sums import MAX_COUNT, VOXELS
from dudmap.fleet.fused_range import FusedRange, joined
from dudmap.fleet.fusion import MAP_FOLDER, PlacedRun, fuse_range, planned_ranges
from dudmap.fleet.inputs import MapHeader, check_runs
from dudmap.fleet.map_samples import sample_map
from dudmap.fleet.registration import RegisteredPair
from dudmap.fleet.rounds import registered_runs
from dudmap.fleet.run_graph import RunGraph
from dudmap.fleet.tiles import TILE_FOLDER, TILESET_FILE, write_tileset, write_tree
from dudmap.fleet.two_runs import save_trajectories
from dudmap.fleet.workers import Workers
from dudmap.input_files import DAMAGE, describe, read_json
from dudmap.own_folder import remove_files

WORLD_FILE, FORMAT = "world.json", "dudmap world 1"
WORK_FOLDER = ".work"
WRITTEN = {
    "": rf"{re.escape(WORLD_FILE)}|{re.escape(TILESET_FILE)}|trajectory(-\d+)?\.txt",
    MAP_FOLDER: r"[0-9a-f]{13}\.npz", TILE_FOLDER: r"[\w-]+\.glb", WORK_FOLDER: r"[\w-]+\.ply",
}  # fmt: skip
"""Names of all files of a world by sub-folder, as regular expressions. They are removed before the next merge."""


@dataclass(frozen=True, eq=False)
class FleetReport:
    """Result of a merge of many runs.

    Attributes:
        out: Folder of the largest world; others lie in it as part-2, part-3, ...
        tree: Content of its world.json.
        pairs: What was found about each pair that was compared.
        graph: Poses of the runs.
        sentences: What the user should know: runs that were not joined, joins that contradict others.
    """

    out: Path
    tree: dict[str, Any]
    pairs: list[RegisteredPair]
    graph: RunGraph
    sentences: list[str]


def merge_fleet(
    runs: Sequence[str | Path], out: str | Path, *, workers: int = 1, note: Callable[[str], None] = lambda _: None
) -> FleetReport:
    """Join the maps of any number of runs.

    The folder receives world.json (runs with their poses, ranges, pairs), map/<code>.npz (one map file per range,
    which ``TsdfVolume.load`` reads), tileset.json and tiles/ (3D Tiles 1.1), and trajectory.txt, trajectory-2.txt, ...
    of all runs in the world of the first. Runs that do not overlap the largest group become worlds of their own in
    part-2, part-3, ... if at least two of them are joined.

    Args:
        runs: Run folders, at least two.
        out: New folder, or one that holds a world, which is replaced.
        workers: Processes.
        note: Told what is being done, a sentence at a time.

    Raises:
        MissingExtraError: A library is not installed.
        ConfigError: A run is named twice, or the voxels differ in size.
        MapError: A run folder is incomplete, or no two runs can be joined.
        DudmapError: ``out`` cannot be used.
    """
    need("fleet", "the merging of more than two runs", ("faiss", "gtsam"))
    folders, out = [Path(run) for run in runs], Path(out)
    like = check_runs(folders, out)
    _check_out(out)
    _load_kernels(like)
    started = time.perf_counter()
    with Workers(workers) as crew:
        pairs, graph = registered_runs(folders, crew, note)
        worlds = [part for part in graph.components if len(part) > 1]
        if not worlds:
            raise MapError(f"no two of the {len(folders)} runs are joined, nothing is written: {_why_not(pairs)}")
        times = {"registration_s": round(time.perf_counter() - started, 2)}
        tree: dict[str, Any] = {}
        for number, part in enumerate(worlds, start=1):
            note(f"{len(part)} runs are fused")
            folder = out if number == 1 else out / f"part-{number}"
            world = _write_world(folder, part, folders, graph, like, crew)
            world |= {"pairs": [_pair_entry(one, folders, graph) for one in pairs if one.a in part and one.b in part]}
            world |= {"not_joined": [str(folders[run]) for run in range(len(folders)) if run not in part]}
            if number == 1:
                tree = world
            else:
                _write_json(folder / WORLD_FILE, world)
        times["total_s"] = round(time.perf_counter() - started, 2)
        tree |= {"compared_pairs": len(pairs), "workers": workers, "cpu_s": round(crew.cpu_s, 1)} | times
        tree["peak_rss_mb"] = sorted(crew.peak_rss_mb.values(), reverse=True)
        _write_json(out / WORLD_FILE, tree)
    return FleetReport(out, tree, pairs, graph, _sentences(graph, folders))


def load_part(world: str | Path, low: NDArray[np.float64], high: NDArray[np.float64]) -> FusedRange:
    """Blocks of a world in all ranges that touch a box, in order.

    ``FusedRange.volume`` makes a map of them.

    Args:
        world: Folder of a world.
        low, high: (3,) corners, metres.

    Raises:
        MapError: The folder holds no world, or nothing of it lies in the box.
    """
    tree = read_world(world)
    touching = [
        one
        for one in tree["ranges"]
        if np.all(np.array(one["low_m"]) <= high) and np.all(np.array(one["high_m"]) >= low)
    ]
    if not touching:
        raise MapError(f"nothing of the world {world} lies in the box from {low.tolist()} to {high.tolist()} m")
    return joined([FusedRange.of(TsdfVolume.load(Path(world) / one["file"])) for one in touching])


def read_world(world: str | Path) -> dict[str, Any]:
    """Content of world.json.

    Raises:
        MapError: It is missing, damaged or of another version, or names files that are not its own.
    """
    path = Path(world) / WORLD_FILE
    try:
        tree = read_json(path)
        if tree.get("format") != FORMAT:
            raise MapError(f"{path} has the format {tree.get('format')!r}; this version reads {FORMAT!r}")
        for one in tree["ranges"]:
            if not re.fullmatch(f"{MAP_FOLDER}/{WRITTEN[MAP_FOLDER]}", one["file"]):
                raise ValueError(f"it names a map file {one['file']!r}; expected one of the folder {MAP_FOLDER}")
            if np.array([one["low_m"], one["high_m"]], float).shape != (2, 3):
                raise ValueError(f"the corners of {one['file']} are no two points")
    except DAMAGE as error:
        raise MapError(f"{world} holds no world of `dudmap merge`: {describe(error)}") from error
    return tree


def _write_world(
    out: Path, part: list[int], folders: Sequence[Path], graph: RunGraph, like: MapHeader, crew: Workers
) -> dict[str, Any]:
    """Fuse joined runs; returns the content of world.json."""
    work = out / WORK_FOLDER
    for folder in (out / MAP_FOLDER, out / TILE_FOLDER, work):
        folder.mkdir(parents=True)
    try:
        runs = [PlacedRun(folders[run], graph.Ts[run]) for run in part]
        results = list(crew.map(partial(fuse_range, like, out, work), planned_ranges(runs, crew)))
        leaves = [tile for _, tiles in results for tile in tiles]
        if leaves:
            root = write_tree(leaves, like.config.voxel_size, out, work, crew)
            write_tileset(root, like.config.voxel_size, out)
    finally:
        shutil.rmtree(work)
    trajectories = save_trajectories(out, [(run.folder, run.T_world_run) for run in runs])
    entries = [
        {"folder": str(run.folder), "T_world_run": run.T_world_run.tolist(), "trajectories": names}
        for run, names in zip(runs, trajectories, strict=True)
    ]
    kept = [entry for entry, _ in results if entry["blocks"]]
    return {
        "format": FORMAT, "voxel_size": like.config.voxel_size, "runs": entries, "ranges": kept,
        "map_blocks": sum(entry["blocks"] for entry in kept), "tiles": len(list((out / TILE_FOLDER).glob("*.glb"))),
        "surface_triangles": sum(tile.triangles for tile in leaves),
    }  # fmt: skip


def _check_out(out: Path) -> None:
    """Remove the world that a folder holds.

    Raises:
        DudmapError: It holds anything else, or cannot be written.
    """
    try:
        if out.exists() and any(out.iterdir()):
            if not (out / WORLD_FILE).is_file():
                raise DudmapError(f"{out} is not empty and holds no world of `dudmap merge`; name another folder")
            parts = ["", *(path.name for path in out.iterdir() if re.fullmatch(r"part-\d+", path.name))]
            places = {f"{part}/{name}".strip("/"): form for part in parts for name, form in WRITTEN.items()}
            remove_files(out, places)
            for name in sorted(places, reverse=True):  # what a folder holds before the folder
                if name and (out / name).exists():
                    (out / name).rmdir()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DudmapError(f"cannot write the world to {out}: {error}") from error


def _load_kernels(like: MapHeader) -> None:
    """Compile the kernels before any worker starts: two would write the same cache at a time."""
    words = np.full((1, VOXELS), MAX_COUNT << 8, np.int32)
    block = FusedRange(morton.encode(np.zeros((1, 3), np.int64)), np.ones(1, bool), np.zeros(1, np.uint8), words, words)
    volume = block.volume(like.volume())
    sample_map(volume, np.zeros((1, 3)))
    volume.extract_mesh()
    volume.extract_chunks(np.zeros(1, np.int32), np.zeros(1, np.int64))


def _pair_entry(one: RegisteredPair, folders: Sequence[Path], graph: RunGraph) -> dict[str, Any]:
    """What world.json says about a pair that was compared."""
    rejected = any((join.a, join.b) == (one.a, one.b) for join in graph.rejected)
    out = {"runs": [str(folders[one.a]), str(folders[one.b])]} | one.pair.tree()
    return out | ({"reason": "other joins contradict it"} if rejected else {})


def _why_not(pairs: Sequence[RegisteredPair]) -> str:
    """The most frequent reason."""
    reasons = [one.pair.reason for one in pairs] or ["no places look alike"]
    return max(reasons, key=reasons.count)


def _sentences(graph: RunGraph, folders: Sequence[Path]) -> list[str]:
    out = []
    first, *others = graph.components
    alone = [folders[part[0]].name for part in others if len(part) == 1]
    if alone:
        out.append(f"{len(alone)} run(s) overlap no other and are left out: {', '.join(alone)}")
    for number, part in enumerate((part for part in others if len(part) > 1), start=2):
        names = ", ".join(folders[run].name for run in part)
        out.append(f"{len(part)} runs overlap each other but not the {len(first)} others, see part-{number}: {names}")
    if graph.rejected:
        names = ", ".join(f"{folders[join.a].name} and {folders[join.b].name}" for join in graph.rejected)
        out.append(f"{len(graph.rejected)} relative pose(s) contradict others and are not used: {names}")
    return out


def _write_json(path: Path, tree: dict[str, Any]) -> None:
    with atomic_file(path) as file:
        file.write((json.dumps(tree, indent=1) + "\n").encode())
