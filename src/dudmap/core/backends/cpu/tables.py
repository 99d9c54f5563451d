"""Marching-cubes tables (Lorensen & Cline 1987), derived by code.

Corner ``4 dx + 2 dy + dz`` lies at (dx, dy, dz). Bit k of a case is set if corner k is inside (sdf < 0). An edge is
(lower corner, axis).

On each face the surface is one or two segments between crossed edges, by that face's signs only; if ambiguous, each
inside corner gets its own. The mesh has no cracks. Closed loops of segments are triangulated without diagonals inside a
face, which could coincide with a neighbour's.
"""

import itertools
from functools import cache

import numpy as np
from numpy.typing import NDArray

CORNERS = tuple(itertools.product((0, 1), repeat=3))
EDGES = tuple((corner, axis) for axis in range(3) for corner in range(8) if CORNERS[corner][axis] == 0)


def _edge_between(a: int, b: int) -> int:
    axis = next(n for n in range(3) if CORNERS[a][n] != CORNERS[b][n])
    return EDGES.index((min(a, b), axis))


def _faces() -> list[list[int]]:
    out = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        square = []
        for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
            offset = [0, 0, 0]
            offset[axis], offset[u], offset[v] = side, du, dv
            square.append(4 * offset[0] + 2 * offset[1] + offset[2])
        out.append(square if side else square[::-1])
    return out


FACES = _faces()
EDGE_FACES = tuple(
    frozenset(
        n for n, face in enumerate(FACES) if any({face[k], face[(k + 1) % 4]} == {c, c | 4 >> axis} for k in range(4))
    )
    for c, axis in EDGES
)


def _segments(case: int) -> dict[int, int]:
    out = {}
    for face in FACES:
        inside = [bool(case >> corner & 1) for corner in face]
        for k in range(4):
            if inside[k] and not inside[(k + 1) % 4]:
                first = k
                while inside[first - 1]:
                    first -= 1
                leaves = _edge_between(face[k], face[(k + 1) % 4])
                enters = _edge_between(face[first - 1], face[first])
                out[enters] = leaves
    return out


def _loops(case: int) -> list[list[int]]:
    following, out = _segments(case), []
    while following:
        start = min(following)
        loop, edge = [start], following.pop(start)
        while edge != start:
            loop.append(edge)
            edge = following.pop(edge)
        out.append(loop)
    return out


@cache
def _triangulations(n: int) -> list[list[tuple[int, int, int]]]:
    def cut(i: int, j: int) -> list[list[tuple[int, int, int]]]:
        if j - i < 2:
            return [[]]
        return [[(i, k, j), *a, *b] for k in range(i + 1, j) for a in cut(i, k) for b in cut(k, j)]

    return cut(0, n - 1)


def _cut(loop: list[int]) -> list[tuple[int, int, int]]:
    n = len(loop)

    def in_faces(triangles: list[tuple[int, int, int]]) -> int:
        diagonals = {
            pair for t in triangles for pair in itertools.combinations(t, 2) if pair[1] - pair[0] not in (1, n - 1)
        }
        return sum(bool(EDGE_FACES[loop[i]] & EDGE_FACES[loop[j]]) for i, j in diagonals)

    best = min(_triangulations(n), key=in_faces)
    return [(loop[i], loop[j], loop[k]) for i, j, k in best]


def triangles(case: int) -> list[tuple[int, int, int]]:
    """Triangles of a case as edges, counter-clockwise seen from outside (sdf > 0)."""
    return [triangle for loop in _loops(case) for triangle in _cut(loop)]


def _table() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    cases = [[EDGES[edge] for triangle in triangles(case) for edge in triangle] for case in range(256)]
    counts = np.array([len(case) // 3 for case in cases], dtype=np.uint8)
    table = np.zeros((256, 3 * int(counts.max()), 2), dtype=np.uint8)
    for case, found in enumerate(cases):
        table[case, : len(found)] = np.array(found, dtype=np.uint8).reshape(-1, 2)
    return table, counts


TRIANGLES, TRIANGLE_COUNT = _table()
"""(256, 15, 2) uint8: up to five triangles of three edges (lower corner, axis); (256,) uint8: their number."""
