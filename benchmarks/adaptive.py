"""Maps with several voxel sizes against maps with one: accuracy, edges, memory and time.

    python benchmarks/adaptive.py synthetic box desk --frames 120 --set volume.adaptive_levels=1
    python benchmarks/adaptive.py recording FOLDER --frames 150
    python benchmarks/adaptive.py synthetic box --true-poses --meshes OUT

Each frame is processed by all systems in turn, so that whatever else the machine does falls on all of them; times are
medians over the frames, relative to uniform voxels of 1 cm. Accuracy and completeness are the mean distances to the
true surface and from the part of it that was seen; "edges" is the mean distance of the true edges of boxes that were
seen from the mesh. Trajectories are aligned with the truth before meshes are compared. Memory is that of the map
(``TsdfVolume.num_bytes``).
"""

import argparse
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap import Config, Slam
from dudmap.core.frames.frame import Frame
from dudmap.core.frames.preprocess import Preprocessor
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.map.adaptive_volume import make_volume
from dudmap.evaluation.reconstruction import compare_surfaces
from dudmap.evaluation.surface import Surface, moved
from dudmap.evaluation.trajectory import ate
from dudmap.io.sequences import open_sequence
from dudmap.lab.benchmark.table import grid
from dudmap.lab.synthetic.recording import DEFAULT_CAMERA, SyntheticSequence
from dudmap.lab.synthetic.scene import BOX
from dudmap.lab.synthetic.setup import sequence

SYSTEMS = {
    "uniform 1 cm": ["volume.voxel_size=0.01"],
    "uniform 0.5 cm": ["volume.voxel_size=0.005"],
    "adaptive": ["volume.voxel_size=0.01", "volume.adaptive=true"],
}
SPACING = 0.002
"""Distance between the sampled points of an edge, metres."""
BESIDE = 0.015
"""Distance from an edge at which both of its faces must have been seen, metres."""


class Fusion:
    """Fuses frames at their true poses, in place of a system that finds them."""

    def __init__(self, camera: Any, config: Config) -> None:
        self.preprocess = Preprocessor(camera, config.preprocess)
        self.volume = make_volume(self.preprocess.camera, config.volume, config.sensor, config.preprocess.depth_max)

    def process(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> None:
        """Fuse a frame."""
        observation = self.preprocess(frame)
        self.volume.integrate(Frame(observation.timestamp, observation.depth, observation.rgb), T_world_camera)


def edge_points(recording: SyntheticSequence) -> NDArray[np.float64]:
    """Points (n, 3) on the edges of the boxes of a scene of which both faces were seen."""
    points, faces = [], []  # points, and beside each of them one on either face with its normal
    for primitive in recording.scene.primitives:
        if primitive.kind != BOX:
            continue
        R, t = primitive.T_body_primitive[:3, :3], primitive.T_body_primitive[:3, 3]
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            half = np.asarray(primitive.half)
            line = np.arange(-half[axis] + BESIDE, half[axis] - BESIDE, SPACING)
            for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                local = np.zeros((len(line), 3))
                local[:, axis], local[:, a], local[:, b] = line, signs[0] * half[a], signs[1] * half[b]
                points.append(local @ R.T + t)
                pair = []
                for k, other, sign, across in ((a, b, signs[0], signs[1]), (b, a, signs[1], signs[0])):
                    beside = local.copy()
                    beside[:, other] -= across * BESIDE
                    normal = np.tile(sign * R[:, k], (len(line), 1))
                    pair.append(np.concatenate([beside @ R.T + t, normal], axis=1))
                faces.append(np.stack(pair, axis=1))
    points, faces = np.concatenate(points), np.concatenate(faces)
    seen = recording.surface(observed=True)
    scale = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    tree = KDTree(np.concatenate([seen.vertices, seen.normals], axis=1) * scale)
    reach = recording.scene.detail
    near = tree.query((faces * scale).reshape(-1, 6), distance_upper_bound=reach)[0].reshape(-1, 2) < reach
    return points[near.all(axis=1)]


def scores(mesh: Mesh, recording: SyntheticSequence, edges: NDArray[np.float64]) -> dict[str, float]:
    """Distances of a mesh in the world of the truth, millimetres."""
    result = compare_surfaces(mesh, recording.surface(), observed=recording.surface(observed=True), samples=100_000)
    to_edges = Surface(mesh, "the mesh").distances(edges.astype(np.float32))
    return {
        "accuracy": 1000 * result.accuracy.mean,
        "accuracy p95": 1000 * result.accuracy.p95,
        "completeness": 1000 * result.completeness.mean,
        "edges": 1000 * float(np.mean(to_edges)),
        "edges p90": 1000 * float(np.quantile(to_edges, 0.9)),
    }


def table(rows: dict[str, dict[str, float]]) -> str:
    """The rows as a table in Markdown."""
    names = list(next(iter(rows.values())))
    return grid(["", *names], [[name, *(f"{row[key]:.2f}" for key in names)] for name, row in rows.items()], words=1)


def measure(
    recording: Any,
    frames: Iterable[int],
    settings: list[str],
    true_poses: bool,
    edges: NDArray[np.float64] | None,
    meshes: Path | None,
) -> dict[str, dict[str, float]]:
    """Figures of each system on a recording."""
    configs = {name: Config().override(["device=cpu", *own, *settings]) for name, own in SYSTEMS.items()}
    kind = Fusion if true_poses else Slam
    systems = {name: kind(recording.camera, config) for name, config in configs.items()}
    times: dict[str, list[float]] = {name: [] for name in systems}
    lost = dict.fromkeys(systems, 0)
    for number in frames:
        frame, T_true = recording[number], np.eye(4)
        if true_poses:
            T_true = recording.ground_truth.interpolate(float(recording.timestamps[number]))
        for name, system in systems.items():
            start = time.perf_counter()
            result = system.process(frame) if isinstance(system, Slam) else system.process(frame, T_true)
            times[name].append(1000 * (time.perf_counter() - start))
            lost[name] += result is not None and result.T_world_camera is None
    rows = {}
    base = np.median(times["uniform 1 cm"][10:])
    for name, system in systems.items():
        volume = system.volume
        start = time.perf_counter()
        mesh = volume.extract_mesh()
        seconds = time.perf_counter() - start
        row = {
            "ms/frame": float(np.median(times[name][10:])),
            "of 1 cm": float(np.median(times[name][10:]) / base),
            "MB": volume.num_bytes / 1e6,
            "mesh ms": 1000 * seconds,
            "triangles/1000": len(mesh.faces) / 1000,
        }
        if isinstance(system, Slam):
            row |= {"lost": lost[name]} | _trajectory(system, recording)
        if edges is not None:
            if isinstance(system, Slam):
                mesh = moved(mesh, _alignment(system, recording))
            row |= scores(mesh, recording, edges)
        if meshes is not None:
            meshes.mkdir(parents=True, exist_ok=True)
            mesh.save(meshes / f"{recording.name}-{name.replace(' ', '-')}.ply")
        rows[name] = row
    return rows


def _trajectory(system: Slam, recording: Any) -> dict[str, float]:
    if recording.ground_truth is None:
        return {}
    return {"ATE": 1000 * ate(system.trajectory, recording.ground_truth).rmse}


def _alignment(system: Slam, recording: SyntheticSequence) -> NDArray[np.float64]:
    """Motion (4, 4) from the world of a system to the true one: the mean over all its poses."""
    twists = []
    first = None
    for stamp, T in zip(system.trajectory.timestamps, system.trajectory.Ts_world_camera, strict=True):
        T_true_world = recording.ground_truth.interpolate(float(stamp)) @ se3.inverse(T)
        first = T_true_world if first is None else first
        twists.append(se3.log(T_true_world @ se3.inverse(first)))
    assert first is not None
    return se3.exp(np.mean(twists, axis=0)) @ first


def main() -> None:
    """Command line of the script; prints one table per recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["synthetic", "recording"])
    parser.add_argument("names", nargs="+", help="scenes, or folders of recordings")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--noise", default="kinect")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--path", default=None, help="camera path of a synthetic recording")
    parser.add_argument("--true-poses", action="store_true", help="only fuse, at the true poses")
    parser.add_argument("--meshes", type=Path, default=None, help="folder for the meshes")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    for name in options.names:
        edges = None
        if options.kind == "synthetic":
            camera = DEFAULT_CAMERA.resized(options.width, options.width * 3 // 4)
            recording = sequence(
                name, [], options.path, options.frames, noise=options.noise, seed=options.seed, camera=camera
            )
            edges = edge_points(recording)
        else:
            recording = open_sequence(name)
        frames = range(min(options.frames, len(recording.timestamps)))
        rows = measure(recording, frames, options.set, options.true_poses, edges, options.meshes)
        print(f"\n{recording.name}, {len(frames)} frames\n\n{table(rows)}", flush=True)


if __name__ == "__main__":
    main()
