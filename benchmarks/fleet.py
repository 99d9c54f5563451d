"""Merging of many runs through one building: accuracy, false joins, time and memory.

python benchmarks/fleet.py [--runs 8|64] [--layout 0] [--folder DIR] [--workers 1 2] [--separate 200] [--out FILE.json]

The recordings (benchmarks/building.py) are rendered and run once and kept in the folder. The merge is repeated for each
number of workers. Pairs without overlap are those whose true surfaces share less than 1 % of their cells of 10 cm; so
many of them are compared as overlapping pairs are, besides those that the place index proposes.
"""

import argparse
import itertools
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from building import CEILING, FLOORS, STOREY, Walk, building, recording, walks

from dudmap.app.pipeline.run import run
from dudmap.config import Config
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.map.volume import TsdfVolume
from dudmap.fleet.merge import FleetReport, merge_fleet
from dudmap.fleet.registration import register_pairs
from dudmap.fleet.run_graph import Join
from dudmap.fleet.workers import Workers

FALSE_DISTANCE, FALSE_ANGLE_DEG = 0.25, 5.0
"""A join whose relative pose is farther off than this (m, deg) joins what is not the same place."""
CELL, NO_OVERLAP, MUCH_OVERLAP = 0.1, 0.01, 0.3
"""Edge of a cell, metres; shares of common cells below which runs do not overlap, and above which they should join."""
VERTICES = 20_000
"""Vertices of a mesh that are measured."""
GHOST = 0.05


class TrueRun:
    """A run folder with what is true of it, in the frame of the building."""

    def __init__(self, folder: Path, walk: Walk) -> None:
        self.folder, self.walk = folder, walk
        estimate, truth = Trajectory.load(folder / "trajectory.txt"), Trajectory.load(folder / "groundtruth.txt")
        self.estimated = estimate.Ts_world_camera
        start, end = truth.timestamps[[0, -1]]
        self.true = np.stack([truth.interpolate(min(max(t, start), end)) for t in estimate.timestamps])
        self.T_building_run = aligned(self.true, self.estimated)
        vertices = Mesh.load(folder / "mesh.ply").vertices.astype(np.float64)
        cells = np.floor(moved(self.T_building_run, vertices) / CELL).astype(np.int64) + 1000
        self.cells = np.unique(cells @ np.array([1 << 40, 1 << 20, 1]))
        self.vertices = chosen(vertices)

    def overlap(self, other: "TrueRun") -> float:
        """Share of the cells of the smaller surface that both have."""
        return len(np.intersect1d(self.cells, other.cells)) / min(len(self.cells), len(other.cells))


def aligned(true, estimated):
    """Rigid motion (4, 4) of estimated to true poses (n, 4, 4): mean rotation, then the best translation.

    A straight walk does not determine the rotation by its positions.
    """
    T = np.eye(4)
    T[:3, :3] = se3.nearest_rotation(np.mean(true[:, :3, :3] @ np.swapaxes(estimated[:, :3, :3], 1, 2), axis=0))
    T[:3, 3] = np.mean(true[:, :3, 3] - estimated[:, :3, 3] @ T[:3, :3].T, axis=0)
    return T


def moved(T, points):
    """Points (n, 3) after a rigid motion."""
    return points @ T[:3, :3].T + T[:3, 3]


def chosen(points):
    """At most VERTICES of some points."""
    return points[np.random.default_rng(0).permutation(len(points))[:VERTICES]]


def prepare(count: int, layout: int, folder: Path) -> list[Path]:
    """Run the system over the recordings that are not done yet."""
    config = Config().override(["volume.voxel_size=0.02", "relocalization.keyframe_gap=5"])
    for walk in walks(count):
        if not (folder / walk.name / "metrics.json").is_file():
            found = run(recording(walk, layout), config, folder / walk.name, progress=False, ahead=0).metrics
            print(walk.name, {key: found.get(key) for key in ("tracked", "lost", "ate_rmse_m")}, flush=True)
    return [folder / walk.name for walk in walks(count)]


def distances(scene, points) -> np.ndarray:
    """Distances (n,) of points (n, 3) to the true surface of the building, metres."""
    return np.concatenate([np.abs(scene.clearance(part)) for part in np.array_split(points, len(points) // 2000 + 1)])


def surface_figures(scene, points) -> dict[str, float]:
    """Accuracy and ghosts of points of a surface in the frame of the building."""
    found = distances(scene, points)
    near = found[found < GHOST]
    return {"accuracy_mm": 1000 * float(near.mean()), "ghost_share": float(np.mean(found >= GHOST))}


def pose_errors(join: Join, runs: list[TrueRun]) -> tuple[float, float]:
    """Error of a relative pose where the camera of the second run was at half time, metres and degrees."""
    a, b = runs[join.a], runs[join.b]
    truth = se3.inverse(a.T_building_run) @ b.T_building_run
    camera = b.estimated[len(b.estimated) // 2]
    error = se3.inverse(truth @ camera) @ join.T_a_b @ camera
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.rotation_angle(error)))


def is_false(error: tuple[float, float]) -> bool:
    """Whether a relative pose joins different places."""
    return error[0] > FALSE_DISTANCE or error[1] > FALSE_ANGLE_DEG


def scored(report: FleetReport, runs: list[TrueRun], layout: int) -> dict[str, object]:
    """All figures of a merge."""
    part, graph, scene = report.graph.components[0], report.graph, building(layout=layout)
    errors = {(join.a, join.b): pose_errors(join, runs) for join in graph.kept}
    accepted = [(one, Join(one.a, one.b, one.pair.T_a_b)) for one in report.pairs if one.pair.T_a_b is not None]
    right = np.array([error for error in errors.values() if not is_false(error)]).reshape(-1, 2)
    placed = np.concatenate([graph.Ts[run] @ runs[run].estimated for run in part])
    truth = np.concatenate([runs[run].true for run in part])
    T_building_world = aligned(truth, placed)
    ate = np.linalg.norm(moved(T_building_world, placed[:, :3, 3]) - truth[:, :3, 3], axis=1)
    single = [surface_figures(scene, moved(runs[run].T_building_run, runs[run].vertices)) for run in part]
    world = []
    for entry in report.tree["ranges"]:
        volume = TsdfVolume.load(report.out / entry["file"])
        world.append(volume.extract_mesh().vertices.astype(np.float64))
    vertices = chosen(np.concatenate(world))
    union = surface_figures(scene, moved(T_building_world, vertices))
    alone = {key: float(np.mean([one[key] for one in single])) for key in ("accuracy_mm", "ghost_share")}
    everything = itertools.combinations(range(len(runs)), 2)
    overlapping = [(a, b) for a, b in everything if runs[a].overlap(runs[b]) > MUCH_OVERLAP]
    return {
        "runs_joined": len(part), "compared_pairs": len(report.pairs), "joins": len(graph.kept),
        "joins_rejected": len(graph.rejected),
        "false_joins_accepted_by_pairs": sum(is_false(pose_errors(join, runs)) for _, join in accepted),
        "false_joins_kept": sum(is_false(error) for error in errors.values()),
        "overlapping_pairs": len(overlapping), "overlapping_joined": sum(pair in errors for pair in overlapping),
        "overlapping_compared": sum((one.a, one.b) in overlapping for one in report.pairs),
        "pose_error_mm_median_max": [round(1000 * float(f(right[:, 0])), 2) for f in (np.median, np.max)],
        "pose_error_deg_median_max": [round(float(f(right[:, 1])), 3) for f in (np.median, np.max)],
        "joins_within_1cm_02deg": int(np.sum((right[:, 0] < 0.01) & (right[:, 1] < 0.2))),
        "ate_rmse_mm": round(1000 * float(np.sqrt(np.mean(ate**2))), 2),
        "single": alone, "union": union, "union_over_single": union["accuracy_mm"] / alone["accuracy_mm"],
        "union_over_single_by_floor": by_floor(scene, vertices, report, runs),
        **{key: report.tree[key] for key in ("workers", "registration_s", "total_s", "cpu_s", "peak_rss_mb", "tiles")},
        "parts": len(report.tree["ranges"]), "map_blocks": report.tree["map_blocks"],
    }  # fmt: skip


def by_floor(scene, vertices, report: FleetReport, runs: list[TrueRun]) -> dict[str, float]:
    """Accuracy of the union over that of the single runs for each floor by itself, aligned by its own runs: without the
    drift of the rides that connect the floors."""
    out = {}
    for floor in range(FLOORS):
        own = [run for run in report.graph.components[0] if runs[run].walk.floor == floor]
        own = [run for run in own if runs[run].walk.kind != "lift"]
        if len(own) < 2:
            continue
        placed = np.concatenate([report.graph.Ts[run] @ runs[run].estimated for run in own])
        points = moved(aligned(np.concatenate([runs[run].true for run in own]), placed), vertices)
        inside = (points[:, 2] > floor * STOREY - 0.1) & (points[:, 2] < floor * STOREY + CEILING + 0.1)
        single = [surface_figures(scene, moved(runs[run].T_building_run, runs[run].vertices)) for run in own]
        alone = float(np.mean([one["accuracy_mm"] for one in single]))
        out[str(floor)] = round(surface_figures(scene, points[inside])["accuracy_mm"] / alone, 3)
    return out


def separate_pairs(folders: list[Path], runs: list[TrueRun], report: FleetReport, count: int, workers: int) -> dict:
    """Decisions on pairs without overlap, those that the merge compared and others by chance."""
    pairs = [(a, b) for a, b in itertools.combinations(range(len(runs)), 2) if runs[a].overlap(runs[b]) < NO_OVERLAP]
    known = {(one.a, one.b): one.pair for one in report.pairs}
    more = [pair for pair in pairs if pair not in known]
    more = [more[k] for k in np.random.default_rng(0).permutation(len(more))]
    compared = [pair for pair in pairs if pair in known]
    with Workers(workers) as crew:
        extra = register_pairs(folders, sorted(more[: max(0, count - len(compared))]), crew, {})
    found = [known[pair] for pair in compared] + [one.pair for one in extra]
    suggested = sum(pair.hypothesis is not None for pair in found)
    return {"pairs": len(found), "suggested_by_features": suggested, "joined": sum(p.T_a_b is not None for p in found)}


def main() -> None:
    """Print all figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=64, help="number of runs: 8 on two floors, else of 64")
    parser.add_argument("--layout", type=int, default=0, help="number of the building; each has a folder of its own")
    parser.add_argument("--folder", type=Path, default=Path("runs/fleet"), help="where runs and worlds are kept")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--separate", type=int, default=200, help="pairs without overlap to compare at least")
    parser.add_argument("--out", type=Path, help="write all figures as JSON")
    options = parser.parse_args()
    folders = prepare(options.runs, options.layout, options.folder)
    runs = [TrueRun(folder, walk) for folder, walk in zip(folders, walks(options.runs), strict=True)]
    rows: dict[str, object] = {}
    report = None
    for workers in options.workers:
        world = options.folder / f"world-{options.runs}-{workers}"
        report = merge_fleet(
            folders, world, workers=workers, note=lambda text: print(text, file=sys.stderr, flush=True)
        )
        rows[f"{workers} workers"] = scored(report, runs, options.layout)
        print(json.dumps(rows[f"{workers} workers"], indent=1), *report.sentences, sep="\n", flush=True)
    assert report is not None
    rows["without overlap"] = separate_pairs(folders, runs, report, options.separate, options.workers[-1])
    print(json.dumps(rows["without overlap"]))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
