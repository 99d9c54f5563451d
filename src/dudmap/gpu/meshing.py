"""Marching cubes on a device: the passes of ``kernels/meshing.py``, with running sums instead of lists of blocks."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import cubes
from dudmap.gpu.memory import resident
from dudmap.gpu.streams import Queue, main_queue
from dudmap.kernels.links import links
from dudmap.kernels.mirror import Mirror
from dudmap.kernels.parameters import MeshParameters
from dudmap.kernels.tables import TRIANGLE_COUNT, TRIANGLES


def extract_surface(
    device: str,
    geometry: Mirror | NDArray[np.int32],
    colors: Mirror | NDArray[np.int32],
    slots: NDArray[np.int32],
    coords: NDArray[np.integer],
    neighbours: NDArray[np.int32],
    parameters: MeshParameters,
    num_meshed: int,
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]:
    """See ``meshing.extract_surface``. Vertices and faces have the same order as there."""
    n = len(slots)
    slots, near, behind, row_of = links(slots, neighbours, len(coords))

    queue = main_queue(device)

    def launch(kernel: Any, rows: int, *arguments: Any) -> None:  # noqa: ANN401
        queue.launch(kernel, (rows, 512), *arguments)

    def up(array: NDArray) -> Any:  # noqa: ANN401
        return wp.array(array, device=device)

    words, paint = resident(geometry, device), resident(colors, device)
    own, near_, behind_, rows = up(slots), up(near), up(behind), up(row_of)
    count, table = up(TRIANGLE_COUNT), up(TRIANGLES)
    cases = wp.zeros((n, 512), dtype=wp.uint8, device=device)
    flags = wp.zeros((n, 512), dtype=wp.uint8, device=device)
    triangles = wp.zeros((n, 512), dtype=wp.int32, device=device)
    owned = wp.zeros((n, 512), dtype=wp.int32, device=device)
    least = max(int(parameters.min_weight), 1)
    jump = int(min(parameters.max_jump / parameters.sdf_unit, 1 << 20))
    launch(cubes.classify, num_meshed, words, near_, least, jump, count, cases, triangles)
    launch(cubes.find_vertices, n, words, near_, behind_, cases, flags, owned)
    first, num_vertices = _offsets(owned, queue)
    first_face, num_faces = _offsets(triangles, queue)
    vertices = wp.empty((num_vertices, 3), dtype=wp.float32, device=device)
    normals = wp.empty((num_vertices, 3), dtype=wp.float32, device=device)
    paints = wp.empty((num_vertices, 3), dtype=wp.uint8, device=device)
    faces = wp.empty((num_faces, 3), dtype=wp.int32, device=device)
    launch(
        cubes.write_vertices, n, words, paint, own, up(coords[slots].astype(np.int32)), near_, behind_, rows, flags,
        first, float(parameters.voxel_size), vertices, paints, normals,
    )  # fmt: skip
    launch(cubes.write_faces, num_meshed, near_, rows, cases, flags, first, first_face, count, table, faces)
    begin = queue.download(first_face)[:, 0].astype(np.int64) if n else np.zeros(0, np.int64)
    arrays = (queue.download(array) for array in (vertices, faces, paints, normals))
    return *arrays, np.concatenate([begin, [num_faces]]).astype(np.int64)


def _offsets(counts: Any, queue: Queue) -> tuple[Any, int]:  # noqa: ANN401
    """Number of the first item of each element of (n, 512) counts, and the number of all items."""
    out = wp.zeros_like(counts)
    if counts.size == 0:
        return out, 0
    wp.utils.array_scan(counts.reshape((counts.size,)), out.reshape((out.size,)), inclusive=False)
    return out, int(queue.download(out[-1])[-1] + queue.download(counts[-1])[-1])
