"""Time of ``dudmap evaluate mesh`` for two meshes of a million vertices; target: below 20 s on two cores.

    python benchmarks/mesh_evaluation.py [--side 1000]

Uses two wavy surfaces of ``side`` x ``side`` vertices, one with 0.5 mm of noise. Times the scores, the coloured error
mesh and the registration, each with its own k-d trees.
"""

import argparse
import time

import numpy as np

from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.evaluation.reconstruction import compare_surfaces, error_mesh
from dudmap.evaluation.surface import moved, register


def waves(side: int, noise: float, seed: int) -> Mesh:
    """Wavy surface of 10 m x 10 m."""
    x, y = np.meshgrid(*[np.linspace(0, 10, side)] * 2, indexing="ij")
    z = 0.5 * np.sin(x) * np.cos(y) + noise * np.random.default_rng(seed).normal(size=x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = [np.stack([a, a + side, a + side + 1], 1), np.stack([a, a + side + 1, a + 1], 1)]
    colors = np.full((len(vertices), 3), 128, np.uint8)
    return Mesh(vertices, np.concatenate(faces).astype(np.int32), colors, np.zeros_like(vertices))


def main() -> None:
    """Command line of the script; prints one line per step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=1000)
    side = parser.parse_args().side
    estimate, reference = waves(side, 0.0005, 0), waves(side, 0.0, 1)
    tilted = moved(estimate, se3.exp(np.array([0.05, -0.03, 0.06, 0.02, -0.03, 0.01])))
    steps = {
        "scores": lambda: f"accuracy {1000 * compare_surfaces(estimate, reference).accuracy.mean:.3f} mm",
        "error mesh": lambda: f"{len(error_mesh(estimate, reference).vertices)} vertices",
        "registration": lambda: f"residual {1000 * register(tilted, reference).rmse:.3f} mm",
    }
    print(f"{len(estimate.vertices)} vertices and {len(estimate.faces)} faces each")
    total = 0.0
    for name, step in steps.items():
        start = time.perf_counter()
        result = step()
        seconds = time.perf_counter() - start
        total += seconds
        print(f"{name:>14}: {seconds:5.1f} s, {result}")
    print(f"{'together':>14}: {total:5.1f} s")


if __name__ == "__main__":
    main()
