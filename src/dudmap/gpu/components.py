"""Connected components on a device: surface segments of a depth image, and regions that grow from moving pixels.

The launches are recorded once for images of a size, and repeated with copies of other images.
"""

# Warp's annotations name float where any type of number is meant
# pyright: reportArgumentType=false

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import components as kernels
from dudmap.gpu.kernels.structs import camera_of
from dudmap.gpu.sequence import Sequence
from dudmap.gpu.streams import Queue

ROUNDS = 3
"""Rounds in which first seeds are carried over links of one direction, which are few; where the last one still finds
something, all is done again with twice as many."""

Buffer = Callable[[tuple[int, ...], Any, Any], Any]
"""Gives the array of a queue alone for a shape, a type and a use."""


@dataclass(frozen=True, eq=False)
class _Program:
    """Launches whose images have fixed addresses.

    Attributes:
        inputs: Images that the launches read.
        steps: The launches.
        result: (h + 1, w) int32; the last row begins with whether the rounds did not suffice, and a count.
    """

    inputs: tuple[Any, ...]
    steps: Sequence
    result: Any


class Components:
    """Connected components of images, one call at a time.

    Args:
        queue: Where the work is done.
        buffer: Arrays for the images of the launches.
        download: Copies an array to the host, and waits for it.
        as_graph: As of ``Sequence``; False where the queue is not that of the thread that captures graphs.
    """

    def __init__(
        self,
        queue: Queue,
        buffer: Buffer,
        download: Callable[[Any], NDArray],
        as_graph: bool | None = None,
    ) -> None:
        self._queue, self._buffer, self._download, self._as_graph = queue, buffer, download, as_graph
        self._programs: dict[tuple[Any, ...], _Program] = {}

    def segment_surface(
        self,
        depth: Any,  # noqa: ANN401 - arrays of Warp
        tolerance: Any,  # noqa: ANN401
        intrinsics: NDArray[np.float32],
        reach: int,
        normal_reach: int,
        sine: float,
        kept: Any,  # noqa: ANN401
    ) -> tuple[NDArray[np.int32], int]:
        """See ``Backend.segment_surface``; the device's equal of the image is written to ``kept``."""
        shape, camera = depth.shape, camera_of(intrinsics)

        def commands(z: Any, step: Any, rounds: int) -> tuple[list[Any], Any]:  # noqa: ANN401
            normals, edge = self._buffer(shape, wp.vec3, "normals"), self._buffer(shape, wp.uint8, "edge")
            numbers = self._buffer((shape[0] * shape[1],), wp.int32, "numbers")
            labels = [self._buffer((shape[0] + 1, shape[1]), wp.int32, f"labels {n}") for n in range(2)]
            links, graph, connect = self._connect(shape, rounds)
            found = [
                self._recorded(kernels.normals_of, shape, z, camera, step, normal_reach, normals),
                self._recorded(kernels.concave_edges, shape, z, camera, step, normals, reach, sine, edge),
                self._recorded(kernels.surface_links, shape, z, camera, step, normals, edge, links),
                *connect,
                self._recorded(kernels.count_rows, shape, links, *graph.tree, graph.rows),
                self._recorded(kernels.number, shape, links, *graph.tree, graph.rows, numbers, graph.status),
                self._recorded(kernels.label, shape, links, *graph.tree, numbers, labels[0]),
            ]
            for _ in range(reach + 1):
                found.append(self._recorded(kernels.grow, shape, z, step, *labels))
                labels.reverse()
            return [*found, self._recorded(kernels.append, 2, graph.status, labels[0])], labels[0]

        key = "segments", *shape, *intrinsics.tolist(), reach, normal_reach, sine
        return self._run(key, (depth, tolerance), commands, kept)

    def moving_regions(
        self,
        seeds: Any,  # noqa: ANN401 - arrays of Warp
        log_odds: Any,  # noqa: ANN401
        depth: Any,  # noqa: ANN401
        tolerance: Any,  # noqa: ANN401
        min_area: float,
        seeded_share: float,
    ) -> NDArray[np.bool_]:
        """See ``Backend.moving_regions``."""
        shape, size = depth.shape, depth.shape[0] * depth.shape[1]

        def commands(marked: Any, odds: Any, z: Any, step: Any, rounds: int) -> tuple[list[Any], Any]:  # noqa: ANN401
            areas, seeded = (self._buffer((size,), wp.int32, use) for use in ("areas", "seeded"))
            out = self._buffer((shape[0] + 1, shape[1]), wp.int32, "regions")
            links, graph, connect = self._connect(shape, rounds)
            sums = links, *graph.tree, areas, seeded
            return [
                self._recorded(kernels.region_links, shape, marked, odds, z, step, links),
                *connect,
                self._recorded(kernels.clear, size, areas, seeded),
                self._recorded(kernels.measure, shape, *sums),
                self._recorded(kernels.moving, shape, *sums, min_area, seeded_share, out),
                self._recorded(kernels.append, 2, graph.status, out),
            ], out

        key = "regions", *shape, min_area, seeded_share
        return self._run(key, (seeds, log_odds, depth, tolerance), commands)[0] > 0

    def _connect(self, shape: tuple[int, int], rounds: int) -> tuple[Any, "_Graph", list[Any]]:
        """Links of each pixel, what is found of their components, and the launches that find it."""
        size = shape[0] * shape[1]
        links = self._buffer(shape, wp.uint8, "links")
        parent, root, first = (self._buffer((size,), wp.int32, use) for use in ("parent", "root", "first"))
        rows, status = self._buffer((shape[0],), wp.int32, "rows"), self._buffer((2,), wp.int32, "status")
        return (
            links,
            _Graph((root, first), rows, status),
            [
                self._recorded(kernels.begin, size, shape[1], parent, first, rows, status),
                self._recorded(kernels.join, shape, links, parent),
                self._recorded(kernels.plant, shape, links, parent, root, first),
                *(
                    self._recorded(kernels.spread, shape, links, root, first, int(turn == rounds), status)
                    for turn in range(1, rounds + 1)
                ),
            ],
        )

    def _run(
        self,
        key: tuple[Any, ...],
        images: tuple[Any, ...],
        commands: Callable[..., tuple[list[Any], Any]],
        kept: Any = None,  # noqa: ANN401
    ) -> tuple[NDArray[np.int32], int]:
        """Image (h, w) that launches make, with as many rounds as it needs, and the number of components.

        Args:
            key: What the launches depend on.
            images: That they read.
            commands: Takes images of the same sizes, and the rounds; gives the launches and their result.
            kept: Receives a copy of the image on the device.
        """
        rounds = ROUNDS
        while True:
            program = self._programs.get((*key, rounds))
            if program is None:
                own = tuple(self._buffer(image.shape, image.dtype, f"{key[0]} {n}") for n, image in enumerate(images))
                launches, result = commands(*own, rounds)
                program = _Program(own, Sequence(self._queue, launches, self._as_graph), result)
                self._programs[(*key, rounds)] = program
            for own, image in zip(program.inputs, images, strict=True):
                self._queue.copy(own, image)
            program.steps.prepare()
            program.steps.run()
            if kept is not None:
                self._queue.copy(kept, program.result[: kept.shape[0]])
            found = self._download(program.result)
            if not found[-1, 0]:
                return found[:-1], int(found[-1, 1])
            rounds *= 2

    def _recorded(self, kernel: Any, dim: Any, *arguments: Any) -> Any:  # noqa: ANN401
        return wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._queue.device, record_cmd=True)


@dataclass(frozen=True, eq=False)
class _Graph:
    """Components of a graph of pixels, arrays of Warp.

    Attributes:
        tree: (n,) root of each pixel's component, and first seed that reaches each root.
        rows: (h,) counts of components, all 0 at first.
        status: (2,) whether the rounds did not suffice, and the number of components.
    """

    tree: tuple[Any, Any]
    rows: Any
    status: Any
