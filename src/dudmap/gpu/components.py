"""Connected components on a device: surface segments of a depth image, and regions that grow from moving pixels."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from dudmap.gpu.kernels import components as kernels
from dudmap.gpu.streams import Queue

ROUNDS = 3
"""Rounds in which first seeds are carried over links of one direction, which are few; where the last one still finds
something, all is done again with twice as many."""

Buffer = Callable[[tuple[int, ...], Any, Any], Any]
"""Gives the array of a queue alone for a shape, a type and a use."""


class Components:
    """Connected components of images, one call at a time.

    Args:
        queue: Where the work is done.
        buffer: Arrays for intermediate results.
        download: Copies an array to the host, and waits for it.
    """

    def __init__(self, queue: Queue, buffer: Buffer, download: Callable[[Any], NDArray]) -> None:
        self._queue, self._buffer, self._download = queue, buffer, download

    def segment_surface(
        self,
        depth: Any,  # noqa: ANN401 - arrays of Warp
        camera: Any,  # noqa: ANN401
        tolerance: Any,  # noqa: ANN401
        reach: int,
        normal_reach: int,
        sine: float,
    ) -> tuple[NDArray[np.int32], int]:
        """See ``Backend.segment_surface``."""
        shape, launch = depth.shape, self._queue.launch
        normals, edge = self._buffer(shape, wp.vec3, "normals"), self._buffer(shape, wp.uint8, "edge")
        links = self._buffer(shape, wp.uint8, "links")
        launch(kernels.normals_of, shape, depth, camera, tolerance, normal_reach, normals)
        launch(kernels.concave_edges, shape, depth, camera, tolerance, normals, reach, sine, edge)
        launch(kernels.surface_links, shape, depth, camera, tolerance, normals, edge, links)

        def finish(root: Any, first: Any, rows: Any, status: Any) -> Any:  # noqa: ANN401
            numbers = self._buffer((shape[0] * shape[1],), wp.int32, "numbers")
            labels = [self._buffer((shape[0] + 1, shape[1]), wp.int32, f"labels {n}") for n in range(2)]
            launch(kernels.count_rows, shape, links, root, first, rows)
            launch(kernels.number, shape, links, root, first, rows, numbers, status)
            launch(kernels.label, shape, links, root, first, numbers, labels[0])
            for _ in range(reach + 1):
                launch(kernels.grow, shape, depth, tolerance, *labels)
                labels.reverse()
            return labels[0]

        labels, count = self._found(links, finish)
        return labels, int(count)

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
        shape, launch, links = depth.shape, self._queue.launch, self._buffer(depth.shape, wp.uint8, "links")
        launch(kernels.region_links, shape, seeds, log_odds, depth, tolerance, links)

        def finish(root: Any, first: Any, _rows: Any, _status: Any) -> Any:  # noqa: ANN401
            size = shape[0] * shape[1]
            areas, seeded = (self._buffer((size,), wp.int32, use) for use in ("areas", "seeded"))
            out = self._buffer((shape[0] + 1, shape[1]), wp.int32, "regions")
            launch(kernels.clear, size, areas, seeded)
            launch(kernels.measure, shape, links, root, first, areas, seeded)
            launch(kernels.moving, shape, links, root, first, areas, seeded, min_area, seeded_share, out)
            return out

        return self._found(links, finish)[0] > 0

    def _found(self, links: Any, finish: Callable[..., Any]) -> tuple[NDArray[np.int32], int]:  # noqa: ANN401
        """Image that ``finish`` makes of the components of linked pixels, and their number where it counts them.

        Args:
            links: (h, w) links of each pixel.
            finish: Takes the root of each pixel's component, the first seed that reaches each root, counts of
                components per row, all 0, and the status; gives an image with a row below it for the status.
        """
        shape, launch, rounds = links.shape, self._queue.launch, ROUNDS
        size = shape[0] * shape[1]
        parent, root, first = (self._buffer((size,), wp.int32, use) for use in ("parent", "root", "first"))
        rows, status = self._buffer((shape[0],), wp.int32, "rows"), self._buffer((2,), wp.int32, "status")
        while True:
            launch(kernels.begin, size, shape[1], parent, first, rows, status)
            launch(kernels.join, shape, links, parent)
            launch(kernels.plant, shape, links, parent, root, first)
            for turn in range(1, rounds + 1):
                launch(kernels.spread, shape, links, root, first, int(turn == rounds), status)
            image = finish(root, first, rows, status)
            launch(kernels.append, 2, status, image)
            found = self._download(image)
            if not found[-1, 0]:
                return found[:-1], int(found[-1, 1])
            rounds *= 2
