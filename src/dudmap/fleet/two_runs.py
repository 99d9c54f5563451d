"""Merging of run folders: two saved maps of one place become one run folder."""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.environment import machine, versions
from dudmap.app.pipeline.run_folder import locked, prepare_run_folder
from dudmap.atomic_file import write_bytes, write_text
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.places.saved_map import KEYFRAME_FILE, MAP_FILE, SavedMap
from dudmap.errors import DatasetError, MapError
from dudmap.fleet.inputs import check_runs
from dudmap.fleet.map_merging import compare_maps, merged_map
from dudmap.input_files import damaged, read_bytes, read_json

MERGE_FILE = "merge.json"


def merge_runs(a: str | Path, b: str | Path, out: str | Path) -> dict[str, Any]:
    """Join the maps of two run folders into a new run folder, in the world frame of the first.

    The folder receives map.npz, keyframes.npz, mesh.ply, config.toml (that of the first), the trajectories of both
    runs in the common world frame (trajectory.txt, trajectory-2.txt, ...), merge.json: the runs, the relative pose
    and the figures of all checks; and metrics.json with the sizes, which viewers and the report read. Nothing is
    written if the maps are not to be joined.

    Returns:
        Content of merge.json.

    Raises:
        MapError: The maps are not to be joined; the message says why.
        DudmapError: As of ``check_runs``, or ``out`` cannot be written.
    """
    a, b, out = Path(a), Path(b), Path(out)
    check_runs([a, b], out)
    maps = SavedMap.load(a), SavedMap.load(b)
    pair = compare_maps(*maps)
    if pair.T_a_b is None:
        raise MapError(f"{a} and {b} are not merged: {pair.reason}")
    merged = merged_map(*maps, pair.T_a_b)
    with locked(out):
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
    """Write the trajectories of runs, moved by the poses (4, 4) of their worlds, as trajectory.txt, trajectory-2.txt,
    ...; names of the files of each run, since a merged run has several.

    Raises:
        DatasetError: A trajectory, or the list of them in merge.json, is damaged.
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
