"""Marching cubes on a device: the passes of ``kernels/meshing.py``, with running sums instead of lists of blocks."""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false, reportReturnType=false

from typing import Any, NamedTuple

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import cubes
from dudmap.gpu.kernels import links as kernels
from dudmap.gpu.memory import resident
from dudmap.gpu.streams import main_queue
from dudmap.kernels.mirror import Mirror
from dudmap.kernels.parameters import MeshArrays, MeshParameters
from dudmap.kernels.tables import TRIANGLE_COUNT, TRIANGLES


class Surface(NamedTuple):
    """A mesh on a device, arrays of Warp: vertices, faces, colours and normals as in ``MeshArrays``, and the first face
    of each voxel of each block."""

    vertices: Any
    faces: Any
    colors: Any
    normals: Any
    first_face: Any


class Links(NamedTuple):
    """Slots (n, 8) of the blocks ahead of each block, rows (n, 8) of those behind it, and the row of each slot."""

    near: Any
    behind: Any
    row_of: Any


class Meshing:
    """Meshes of blocks of a map, computed in the main queue.

    Which blocks touch follows from their coordinates, so that the list of neighbours is not needed.

    Args:
        device: Name of the device.
    """

    def __init__(self, device: str) -> None:
        self._device, self._queue = device, main_queue(device)

    def extract_mesh(
        self,
        geometry: Mirror | NDArray[np.int32],
        colors: Mirror | NDArray[np.int32],
        slots: NDArray[np.int32],
        coords: NDArray[np.integer],
        _neighbours: Any,  # noqa: ANN401
        parameters: MeshParameters,
    ) -> MeshArrays:
        """See ``Backend.extract_mesh``."""
        found = self._surface(geometry, colors, slots, coords, parameters, len(slots))
        return MeshArrays(*(self._queue.download(array) for array in found[:4]))

    def extract_chunks(
        self,
        geometry: Mirror | NDArray[np.int32],
        colors: Mirror | NDArray[np.int32],
        slots: NDArray[np.int32],
        coords: NDArray[np.integer],
        _neighbours: Any,  # noqa: ANN401
        parameters: MeshParameters,
        chunks: NDArray[np.integer],
    ) -> list[MeshArrays]:
        """See ``Backend.extract_chunks``. The vertices of a chunk have the order that they have there."""
        num_chunks = int(chunks.max(initial=-1)) + 1
        order = np.argsort(np.where(chunks < 0, num_chunks, chunks), kind="stable")
        rows = np.concatenate([[0], np.bincount(chunks[chunks >= 0], minlength=num_chunks)]).cumsum()
        if num_chunks == 0:
            return []
        found = self._surface(geometry, colors, slots[order], coords, parameters, int(rows[-1]))
        begin = self._numbers(num_chunks + 1)
        self._queue.launch(
            kernels.begin_chunks, num_chunks + 1, self._up(rows.astype(np.int32)), found.first_face, len(found.faces),
            begin,
        )  # fmt: skip
        starts, faces, own = self._split(found, begin)
        first, last = self._queue.download(starts), self._queue.download(begin)
        parts = [self._queue.download(array) for array in (own[0], faces, own[1], own[2])]
        out = []
        for chunk in range(num_chunks):  # copies: a view would keep the arrays of all chunks alive
            by_vertex, by_face = slice(first[chunk], first[chunk + 1]), slice(last[chunk], last[chunk + 1])
            ranges = by_vertex, by_face, by_vertex, by_vertex
            out.append(MeshArrays(*(part[one].copy() for part, one in zip(parts, ranges, strict=True))))
        return out

    def _split(self, surface: Surface, begin: Any) -> tuple[Any, Any, tuple[Any, Any, Any]]:  # noqa: ANN401
        """First vertex of each chunk, faces with vertices numbered within it, and its vertices, colours and normals;
        ``begin`` is the first face of each chunk."""
        corners, launch = 3 * len(surface.faces), self._queue.launch  # of which most have a vertex in common
        table, place, marks = self._table(corners // 2), self._numbers(corners), self._numbers(corners)
        first = wp.full(table.size, np.iinfo(np.int32).max, dtype=wp.int32, device=self._device)
        starts, local = self._numbers(begin.size), self._numbers((len(surface.faces), 3))
        launch(kernels.find_corners, corners, surface.faces, begin, table, first, place)
        launch(kernels.mark_first, corners, first, place, marks)
        ends = self._numbers(corners)
        if corners:
            wp.utils.array_scan(marks, ends, inclusive=True)
        launch(kernels.begin_vertices, begin.size, begin, ends, starts)
        count = int(self._queue.download(ends[-1:])[0]) if corners else 0
        ids = self._numbers(count)
        launch(kernels.split, corners, surface.faces, begin, first, place, ends, starts, local, ids)
        shared = surface.vertices, surface.colors, surface.normals
        own = tuple(wp.empty((count, 3), dtype=array.dtype, device=self._device) for array in shared)
        launch(kernels.copy_vertices, (count, 3), ids, *shared, *own)
        return starts, local, own

    def _surface(
        self,
        geometry: Mirror | NDArray[np.int32],
        colors: Mirror | NDArray[np.int32],
        slots: NDArray[np.int32],
        coords: NDArray[np.integer],
        parameters: MeshParameters,
        num_meshed: int,
    ) -> Surface:
        """See ``meshing.extract_surface``. Vertices and faces have the same order as there."""
        n = len(slots)

        def launch(kernel: Any, rows: int, *arguments: Any) -> None:  # noqa: ANN401
            self._queue.launch(kernel, (rows, 512), *arguments)

        words, paint = resident(geometry, self._device), resident(colors, self._device)
        own, place = self._up(np.ascontiguousarray(slots, np.int32)), self._up(coords[slots].astype(np.int32))
        near, behind, rows = self._links(own, place, len(coords))
        count, table = self._up(TRIANGLE_COUNT), self._up(TRIANGLES)
        cases, flags = (wp.zeros((n, 512), dtype=wp.uint8, device=self._device) for _ in range(2))
        triangles, owned = (wp.zeros((n, 512), dtype=wp.int32, device=self._device) for _ in range(2))
        least = max(int(parameters.min_weight), 1)
        jump = int(min(parameters.max_jump / parameters.sdf_unit, 1 << 20))
        launch(cubes.classify, num_meshed, words, near, least, jump, count, cases, triangles)
        launch(cubes.find_vertices, n, words, near, behind, cases, flags, owned)
        first, num_vertices = self._offsets(owned)
        first_face, num_faces = self._offsets(triangles)
        vertices, normals = (wp.empty((num_vertices, 3), dtype=wp.float32, device=self._device) for _ in range(2))
        paints = wp.empty((num_vertices, 3), dtype=wp.uint8, device=self._device)
        faces = self._numbers((num_faces, 3))
        launch(
            cubes.write_vertices, n, words, paint, own, place, near, behind, rows, flags, first,
            float(parameters.voxel_size), vertices, paints, normals,
        )  # fmt: skip
        launch(cubes.write_faces, num_meshed, near, rows, cases, flags, first, first_face, count, table, faces)
        return Surface(vertices, faces, paints, normals, first_face)

    def _links(self, slots: Any, coords: Any, num_slots: int) -> Links:  # noqa: ANN401
        """Which of the blocks of slots (n,) at coordinates (n, 3) touch; see ``links.links``."""
        n, table = slots.size, self._table(slots.size)
        row_of = wp.full(num_slots, -1, dtype=wp.int32, device=self._device)
        near, behind = self._numbers((n, 8)), self._numbers((n, 8))
        self._queue.launch(kernels.insert_blocks, n, coords, slots, table, row_of)
        self._queue.launch(kernels.link, (n, 8), coords, slots, table, near, behind)
        return Links(near, behind, row_of)

    def _table(self, count: int) -> Any:  # noqa: ANN401
        """An empty hash table with more than twice as many places, a power of two."""
        return wp.full(1 << (2 * count).bit_length(), -1, dtype=wp.int32, device=self._device)

    def _offsets(self, counts: Any) -> tuple[Any, int]:  # noqa: ANN401
        """Number of the first item of each element of (n, 512) counts, and the number of all items."""
        out = wp.zeros_like(counts)
        if counts.size == 0:
            return out, 0
        wp.utils.array_scan(counts.reshape((counts.size,)), out.reshape((out.size,)), inclusive=False)
        return out, int(self._queue.download(out[-1])[-1] + self._queue.download(counts[-1])[-1])

    def _numbers(self, shape: Any) -> Any:  # noqa: ANN401
        return wp.empty(shape, dtype=wp.int32, device=self._device)

    def _up(self, array: NDArray) -> Any:  # noqa: ANN401
        return wp.array(array, device=self._device)
