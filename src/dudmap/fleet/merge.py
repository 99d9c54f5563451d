"""Merge run folders: two maps into a run folder, many into worlds of parts and tiles."""

import json
import logging
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap import interruption
from dudmap.app.pipeline.environment import machine, versions
from dudmap.app.pipeline.run_folder import locked, prepare_run_folder
from dudmap.atomic_file import write_bytes, write_text
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map import morton
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap
from dudmap.errors import DatasetError, DudmapError, MapError
from dudmap.fleet.fusion import (
    MAP_FOLDER,
    TILE_FOLDER,
    TILESET_FILE,
    PlacedRun,
    fuse_range,
    planned_ranges,
    write_tileset,
    write_tree,
)
from dudmap.fleet.map_fusion import MAX_COUNT, VOXELS, FusedRange
from dudmap.fleet.map_merging import compare_maps, merged_map
from dudmap.fleet.map_samples import sample_map
from dudmap.fleet.registration import Pairs, registered_runs
from dudmap.fleet.run_graph import RunGraph
from dudmap.fleet.workers import MapHeader, Workers, check_runs
from dudmap.input_files import damaged, read_bytes, read_json
from dudmap.own_folder import remove_files

log = logging.getLogger(__name__)

MERGE_FILE = "merge.json"

WORLD_FILE, FORMAT = "world.json", "dudmap world 1"
WORK_FOLDER = ".work"
WRITTEN = {
    "": rf"{re.escape(WORLD_FILE)}|{re.escape(TILESET_FILE)}|trajectory(-\d+)?\.txt",
    MAP_FOLDER: r"[0-9a-f]{13}\.npz", TILE_FOLDER: r"[\w-]+\.glb", WORK_FOLDER: r"[\w-]+\.ply",
}  # fmt: skip
"""File names of a world by sub-folder, regular expressions."""


def merge_runs(a: str | Path, b: str | Path, out: str | Path) -> dict[str, Any]:
    """Merge two run folders into a new one, in the first world; return merge.json. Nothing is written if they do not
    match.

    It holds map, keyframes, mesh, metrics.json, merge.json, the first config.toml, and both trajectories.

    Raises:
        MapError: The maps do not match; it says why.
        DudmapError: As in ``check_runs``, or ``out`` cannot be written.
    """
    a, b, out = Path(a), Path(b), Path(out)
    check_runs([a, b], out)
    maps = SavedMap.load(a), SavedMap.load(b)
    pair = compare_maps(*maps)
    if pair.T_a_b is None:
        raise MapError(f"{a} and {b} are not merged: {pair.reason}")
    merged = merged_map(*maps, pair.T_a_b)
    with interruption.postponed(), locked(out):
        prepare_run_folder(out, None, save_masks=False)
        of_a, of_b = save_trajectories(out, [(a, np.eye(4)), (b, pair.T_a_b)])
        merged.volume.save(out / MAP_FILE)
        merged.save_keyframes(out / KEYFRAME_FILE)
        mesh = merged.volume.extract_mesh()
        mesh.save(out / "mesh.ply")
        if (a / "config.toml").is_file():
            write_bytes(out / "config.toml", read_bytes(a / "config.toml"))
        tree: dict[str, Any] = {"runs": [str(a), str(b)], "trajectories": of_a + of_b} | pair.tree()
        sizes = {"map_blocks": merged.volume.num_blocks, "map_bytes": merged.volume.num_bytes}
        sizes |= {"mesh_vertices": len(mesh.vertices), "mesh_triangles": len(mesh.faces)}
        finer = [level.blocks.num_voxel_blocks for saved in maps for level in saved.volume.levels]
        tree |= sizes | {"finer_blocks_left_out": sum(finer)}
        poses = sum(len(Trajectory.load(out / name)) for name in tree["trajectories"])
        metrics: dict[str, Any] = {"sequence": f"{a.name} and {b.name}", "complete": True}
        metrics |= {"frames": poses, "tracked": poses}
        metrics |= sizes | {"camera": asdict(merged.volume.camera), "versions": versions(), "machine": machine()}
        write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
        write_text(out / MERGE_FILE, json.dumps(tree, indent=2) + "\n")
    return tree


def save_trajectories(out: Path, runs: Sequence[tuple[Path, NDArray[np.float64]]]) -> list[list[str]]:
    """Write trajectory.txt, trajectory-2.txt, ..., moved by poses (4, 4) of their worlds; returns file names per run.

    Raises:
        DatasetError: A trajectory, or their list in merge.json, is damaged.
    """
    names: list[list[str]] = []
    for folder, T in runs:
        known = ["trajectory.txt"]
        if (folder / MERGE_FILE).is_file():
            with damaged(DatasetError, folder / MERGE_FILE):
                known = read_json(folder / MERGE_FILE)["trajectories"]
                if not all(re.fullmatch(r"trajectory(-\d+)?\.txt", name) for name in known):
                    raise ValueError(f"it names {known} as its trajectories")
        first = 1 + sum(map(len, names))
        names.append([f"trajectory-{n}.txt" if n > 1 else "trajectory.txt" for n in range(first, first + len(known))])
        for source, name in zip(known, names[-1], strict=True):
            found = Trajectory.load(folder / source)
            Trajectory(found.timestamps, T @ found.Ts_world_camera).save(out / name)
    return names


@dataclass(frozen=True, eq=False)
class FleetReport:
    """Result of a merge of many runs.

    Attributes:
        out: Folder of the largest world, with the others as part-2, part-3, ...
        sentences: Runs not joined, contradictory joins.
    """

    out: Path
    tree: dict[str, Any]
    sentences: list[str]


def merge_fleet(runs: Sequence[str | Path], out: str | Path, *, workers: int = 1) -> FleetReport:
    """Merge the maps of two or more runs into a new folder, or over a world.

    Writes world.json, map/<code>.npz per range (``TsdfVolume.load``), tileset.json and tiles/ (3D Tiles 1.1), and
    trajectory.txt, trajectory-2.txt, ... in the first run's world. Other groups of runs become worlds in part-2,
    part-3, ... ``workers``: processes.

    Raises:
        ConfigError: A run is named twice, or voxels differ in size.
        MapError: An incomplete run folder, or no two runs can be joined.
        DudmapError: ``out`` cannot be used.
    """
    folders, out = [Path(run) for run in runs], Path(out)
    like = check_runs(folders, out)
    _check_out(out)
    _load_kernels(like)
    started = time.perf_counter()
    with Workers(workers) as crew:
        pairs, graph = registered_runs(folders, crew)
        worlds = [part for part in graph.components if len(part) > 1]
        if not worlds:
            raise MapError(f"no two of the {len(folders)} runs are joined, nothing is written: {_why_not(pairs)}")
        times = {"registration_s": round(time.perf_counter() - started, 2)}
        tree: dict[str, Any] = {}
        for number, part in enumerate(worlds, start=1):
            log.info("%d runs are fused", len(part))
            folder = out if number == 1 else out / f"part-{number}"
            world = _write_world(folder, part, folders, graph, like, crew)
            world |= {"pairs": [_pair_entry(one, pairs, folders, graph) for one in pairs if set(one) <= set(part)]}
            world |= {"not_joined": [str(folders[run]) for run in range(len(folders)) if run not in part]}
            if number == 1:
                tree = world
            else:
                write_text(folder / WORLD_FILE, json.dumps(world, indent=1) + "\n")
        times["total_s"] = round(time.perf_counter() - started, 2)
        tree |= {"compared_pairs": len(pairs), "workers": workers, "cpu_s": round(crew.cpu_s, 1)} | times
        tree["peak_rss_mb"] = sorted(crew.peak_rss_mb.values(), reverse=True)
        write_text(out / WORLD_FILE, json.dumps(tree, indent=1) + "\n")
    return FleetReport(out, tree, _sentences(graph, folders))


def _write_world(
    out: Path, part: list[int], folders: Sequence[Path], graph: RunGraph, like: MapHeader, crew: Workers
) -> dict[str, Any]:
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
    try:
        if out.exists() and any(out.iterdir()):
            if not (out / WORLD_FILE).is_file():
                raise DudmapError(f"{out} is not empty and holds no world of `dudmap merge`; name another folder")
            parts = ["", *(path.name for path in out.iterdir() if re.fullmatch(r"part-\d+", path.name))]
            places = {f"{part}/{name}".strip("/"): form for part in parts for name, form in WRITTEN.items()}
            remove_files(out, places)
            for name in sorted(places, reverse=True):  # subfolders before their parent
                if name and (out / name).exists():
                    (out / name).rmdir()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DudmapError(f"cannot write the world to {out}: {error}") from error


def _load_kernels(like: MapHeader) -> None:
    """Compile kernels before the workers, which must not write one cache."""
    words = np.full((1, VOXELS), MAX_COUNT << 8, np.int32)
    block = FusedRange(morton.encode(np.zeros((1, 3), np.int64)), np.ones(1, bool), np.zeros(1, np.uint8), words, words)
    volume = block.volume(like.volume())
    sample_map(volume, np.zeros((1, 3)))
    volume.extract_mesh()
    volume.extract_chunks(np.zeros(1, np.int32), np.zeros(1, np.int64))


def _pair_entry(runs: tuple[int, int], pairs: Pairs, folders: Sequence[Path], graph: RunGraph) -> dict[str, Any]:
    out = {"runs": [str(folders[run]) for run in runs]} | pairs[runs].tree()
    rejected = runs in [(join.a, join.b) for join in graph.rejected]
    return out | ({"reason": "other joins contradict it"} if rejected else {})


def _why_not(pairs: Pairs) -> str:
    reasons = [pair.reason for pair in pairs.values()] or ["no places look alike"]
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
