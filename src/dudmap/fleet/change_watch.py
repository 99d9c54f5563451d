"""Report changes against an earlier map during a run."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dudmap.app.pipeline.observer import RunObserver
from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.map import morton
from dudmap.core.places.saved_map import SavedMap
from dudmap.fleet.change_evidence import DEVIATIONS, components
from dudmap.fleet.change_objects import LEAST_FACING
from dudmap.fleet.map_samples import sample_map, transformed

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

WATCH_FILE = "changes.jsonl"
CELL = 0.05
"""Cells of evidence, metres."""
COLUMNS = 80
"""Compared pixels per row."""
FRAMES, SECONDS = 6, 0.75
"""Frames for minus against a change, and their time, seconds: no passers-by."""
LEAST_CELLS = 3.0
"""Smallest change in cells, in faces of the smallest size."""
KINDS = ("appeared", "disappeared")


class _Cells:
    """Frames for and against a change in cells.

    Attributes:
        codes: (n,) int64 Morton codes, ascending.
        score: (n,) frames for minus against.
        first, last: (n,) seconds.
        reported: (n,) bool.
    """

    def __init__(self, codes: NDArray[np.int64]) -> None:
        self.codes, n = codes, len(codes)
        self.score, self.first, self.last = np.zeros(n, np.int32), np.zeros(n), np.zeros(n)
        self.reported = np.zeros(n, bool)

    def rows_of(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        codes = np.unique(morton.encode(np.floor(points / CELL).astype(np.int64)))
        new = np.setdiff1d(codes, self.codes, assume_unique=True)
        if len(new):
            at = np.searchsorted(self.codes, new)
            self.codes = np.insert(self.codes, at, new)
            self.score, self.reported = np.insert(self.score, at, 0), np.insert(self.reported, at, False)
            self.first, self.last = np.insert(self.first, at, 0.0), np.insert(self.last, at, 0.0)
        return np.searchsorted(self.codes, codes)

    def count(self, rows: NDArray[np.intp], gain: int, now: float) -> None:
        fresh = rows[self.score[rows] <= 0]
        self.first[fresh], self.last[rows] = now, now
        self.score[rows] = np.maximum(self.score[rows] + gain, 0)

    def certain(self) -> NDArray[np.intp]:
        return np.flatnonzero((self.score >= FRAMES) & (self.last - self.first >= SECONDS) & ~self.reported)


class ChangeWatch(RunObserver):
    """Writes changes.jsonl: id, kind, box, centre, timestamp and frame per change.

    Even frames search new surface in the earlier free space, odd ones earlier surface that is looked through. Later
    denied changes are written again as "withdrawn". Each is an event "change".

    Args:
        before: Earlier map, not the one that the run updates.
        min_size: Edge of the smallest thing, metres.
    """

    def __init__(self, before: SavedMap, others: "tuple[RunObserver, ...]" = (), min_size: float = 0.1) -> None:
        self.volume, self.others, self.min_size = before.volume, others, min_size
        self.reported: list[dict[str, Any]] = []
        self._members: dict[int, NDArray[np.int64]] = {}
        mesh = before.volume.extract_mesh()
        vertices = mesh.vertices.astype(np.float64)
        codes, first = np.unique(morton.encode(np.floor(vertices / CELL).astype(np.int64)), return_index=True)
        self._codes, self._surface, self._normals = codes, vertices[first], mesh.normals[first].astype(np.float64)
        self._cells = self._fresh()
        self._file: TextIO | None = None
        self._slam: Slam | None = None

    def start(self, slam: "Slam", out: Path | None, count: int | None) -> None:
        """A pass begins; without a folder nothing is written."""
        self._slam, self.reported, self._members = slam, [], {}
        self._cells = self._fresh()
        self._close()
        if out is not None:
            self._file = (out / WATCH_FILE).open("w", encoding="utf-8", buffering=1)

    def _fresh(self) -> dict[str, _Cells]:
        return {"appeared": _Cells(np.empty(0, np.int64)), "disappeared": _Cells(self._codes)}

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Observe a processed frame."""
        if isinstance(read.frame, Frame):
            self.look(index, read.frame, result)

    def look(self, index: int, frame: Frame, result: "FrameResult") -> None:
        """Count the evidence of a tracked frame, and report certain changes."""
        T = result.T_world_camera
        if T is None or result.submap != 0 or result.status != "tracked":
            return
        kind = KINDS[index % 2]
        self._count(kind, frame, T)
        if index % 8 < 2:
            self._withdraw(kind, index, frame.timestamp)
            self._report(kind, index, frame.timestamp)

    def finish(self, out: Path) -> None:
        """Close the file."""
        self._close()

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _count(self, kind: str, frame: Frame, T: NDArray[np.float64]) -> None:
        assert self._slam is not None
        camera, cells, sensor = self._slam.camera, self._cells[kind], self.volume.sensor
        if kind == "disappeared":
            through, on = self._looked_at(self._surface, frame.depth, T)
            rays = T[:3, 3] - self._surface[through]
            faces = (rays * self._normals[through]).sum(axis=1) > LEAST_FACING * np.linalg.norm(rays, axis=1)
            through = through[faces]
            cells.count(through, 1, frame.timestamp)
            cells.count(on, -1, frame.timestamp)
            return
        step = max(1, frame.depth.shape[1] // COLUMNS)
        depth = frame.depth[step // 2 :: step, step // 2 :: step]
        v, u = np.nonzero((depth > 0) & (depth < self.volume.depth_max))
        z = depth[v, u].astype(np.float64)
        points = transformed(T, camera.points(u * step + step // 2, v * step + step // 2, z))
        samples = sample_map(self.volume, points)
        free = samples.is_free(self._margin(z, sensor))
        cells.count(cells.rows_of(points[free]), 1, frame.timestamp)
        rows = np.flatnonzero(cells.score > 0)
        cells.count(rows[self._looked_at(_centres(cells.codes[rows]), frame.depth, T)[0]], -1, frame.timestamp)

    def _looked_at(
        self, points: NDArray[np.float64], depth: NDArray[np.float32], T: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        assert self._slam is not None
        camera, local = self._slam.camera, transformed(se3.inverse(T), points)
        ahead = (local[:, 2] > 0.3) & (local[:, 2] < self.volume.depth_max)
        ahead &= np.abs(local[:, 0]) < local[:, 2] * camera.width / camera.fx
        near = np.flatnonzero(ahead)
        rows, u, v = camera.nearest_pixels(local[near], border=1)
        near = near[rows]
        z, reading = local[near, 2], depth[v, u]
        nearest = np.minimum.reduce([reading, depth[v, u - 1], depth[v, u + 1], depth[v - 1, u]])
        margin = self._margin(z, self.volume.sensor)
        return near[nearest > z + 2 * margin], near[np.abs(reading - z) < margin]

    def _margin(self, z: NDArray[np.float64], sensor: Any) -> NDArray[np.float64]:  # noqa: ANN401 - its configuration
        return 2 * self.volume.voxel_size + DEVIATIONS * sensor.sigma(z)

    def _report(self, kind: str, index: int, now: float) -> None:
        cells = self._cells[kind]
        rows = cells.certain()
        wanted = LEAST_CELLS * (self.min_size / CELL) ** 2
        if len(rows) < wanted:
            return
        centres = _centres(cells.codes[rows])
        group = components(KDTree(centres).query_pairs(2.5 * CELL, output_type="ndarray"), len(centres))
        for number in np.flatnonzero(np.bincount(group) >= wanted):
            members = np.flatnonzero(group == number)
            cells.reported[rows[members]] = True
            box = np.stack([centres[members].min(axis=0) - CELL / 2, centres[members].max(axis=0) + CELL / 2])
            if self._is_known(kind, box):
                continue
            row = {
                "timestamp": now, "frame": index, "id": len(self._members) + 1, "kind": kind,
                "centre": box.mean(axis=0).round(3).tolist(), "box": box.round(3).tolist(),
            }  # fmt: skip
            self.reported.append(row)
            self._members[row["id"]] = cells.codes[rows[members]]
            self._tell(row)

    def _withdraw(self, kind: str, index: int, now: float) -> None:
        cells = self._cells[kind]
        for row in [row for row in self.reported if row["kind"] == kind]:
            rows = np.searchsorted(cells.codes, self._members[row["id"]])
            if np.median(cells.score[rows]) == 0:
                cells.reported[rows] = False
                self.reported.remove(row)
                self._tell(row | {"timestamp": now, "frame": index, "kind": "withdrawn"})

    def _tell(self, row: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(row) + "\n")
        for observer in self.others:
            observer.event("change", **row)

    def _is_known(self, kind: str, box: NDArray[np.float64]) -> bool:
        boxes = [np.array(row["box"]) for row in self.reported if row["kind"] == kind]
        return any(np.all((box[0] < b[1] + 2 * CELL) & (b[0] - 2 * CELL < box[1])) for b in boxes)


def _centres(codes: NDArray[np.int64]) -> NDArray[np.float64]:
    return (morton.decode(codes).astype(np.float64) + 0.5) * CELL
