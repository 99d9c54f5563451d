"""A run folder as the viewers read it."""

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dudmap.app.viewing.snapshot import KINDS, FrameFigures, MoverBox
from dudmap.core.geometry.mesh import Mesh, ply_layout
from dudmap.core.geometry.mesh_pieces import load_simplified
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.core.places.saved_map import KEYFRAME_FILE, load_keyframes
from dudmap.errors import DatasetError
from dudmap.evaluation.trajectory import AteResult, ate
from dudmap.input_files import DAMAGE, damaged, read_bytes, read_text
from dudmap.io.exporting.mesh_editing import without_small_pieces
from dudmap.io.exporting.run_content import RunContent

FOLDER = "thumbnails"
NOT_STAGES = ("timestamp", "state", "fused", "dynamic_share", "reading", "total", "dropped", "latency", "shed")
MAX_TRIANGLES = 5_000_000
"""Triangles in a page or window; larger meshes are simplified."""
LARGEST_THUMBNAIL = 2**22
"""Largest thumbnail, bytes; usual: 10 to 30 kB."""


@dataclass(frozen=True, eq=False)
class RunFiles(RunContent):
    """A run for viewers, with or without trajectory and mesh."""

    @classmethod
    def load(cls, folder: str | Path) -> "RunFiles":
        """Open a run folder.

        Raises:
            DatasetError: No run folder, or a newer version.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise DatasetError(f"there is no run folder {folder}; `dudmap run RECORDING --out {folder}` would write it")
        if not (folder / "metrics.json").is_file():
            raise DatasetError(f"{folder} is no complete run folder: it has no metrics.json; name one of `dudmap run`")
        run = cls(folder)
        run.check_version()
        return run

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of all tracked frames, possibly none."""
        path = self.folder / "trajectory.txt"
        tracked = self.metrics.get("tracked") and path.is_file()
        return Trajectory.load(path) if tracked else Trajectory.from_poses([])

    @cached_property
    def mesh(self) -> Mesh | None:
        """Mesh without its smallest pieces; None if no frame was fused. A very large one is simplified while
        reading."""
        path = self.folder / "mesh.ply"
        if not path.is_file() or not self.metrics.get("mesh_triangles"):
            return None
        layout = ply_layout(path)
        large = layout is not None and len(layout[1]) > MAX_TRIANGLES
        return without_small_pieces(load_simplified(path, MAX_TRIANGLES) if large else Mesh.load(path))

    @cached_property
    def truth(self) -> Trajectory | None:
        """True trajectory in its own world, or None."""
        path = self.folder / "groundtruth.txt"
        return Trajectory.load(path) if path.is_file() else None

    @cached_property
    def errors(self) -> AteResult | None:
        """Absolute trajectory errors; None without ground truth or match in time."""
        try:
            return None if self.truth is None else ate(self.trajectory, self.truth)
        except DatasetError:  # accuracy_missing in metrics.json gives the reason
            return None

    @cached_property
    def keyframes(self) -> np.ndarray:
        """Poses (N, 4, 4) of keyframes; none without a saved map."""
        path = self.folder / KEYFRAME_FILE
        poses = [keyframe.T_world_camera for keyframe in load_keyframes(path)[0]] if path.is_file() else []
        return np.array(poses).reshape(-1, 4, 4)

    @property
    def config(self) -> str:
        """Text of config.toml, empty if there is none."""
        path = self.folder / "config.toml"
        with damaged(DatasetError, path):
            return read_text(path) if path.is_file() else ""

    @cached_property
    def frames(self) -> list[dict[str, str]]:
        """Rows of timings.csv, one per frame."""
        path = self.folder / "timings.csv"
        if not path.is_file():
            return []
        with damaged(DatasetError, path):
            rows = list(csv.DictReader(read_text(path).splitlines()))
        numbers = [name for name in (rows[0] if rows else ()) if name not in ("state", "fused")]
        for number, row in enumerate(rows, start=2):
            try:
                _ = [float(row[name]) for name in ("timestamp", "total", "dynamic_share")]
                _ = [float(row[name] or 0) for name in numbers]
            except DAMAGE as error:
                raise DatasetError(f"{path}, line {number} is damaged ({error!r}); run again") from None
        return rows

    @property
    def stages(self) -> list[str]:
        """Stages in the order of timings.csv."""
        return [key for key in self.frames[0] if key not in NOT_STAGES] if self.frames else []

    def column(self, name: str) -> np.ndarray:
        """Column of timings.csv, one number per processed frame."""
        return np.array([float(row[name] or 0) for row in self.frames])

    @cached_property
    def boxes(self) -> dict[str, tuple[MoverBox, ...]]:
        """Moving objects by timestamp, as text."""
        with damaged(DatasetError, self.folder / "movers.jsonl"):
            return {
                f"{row['timestamp']:.6f}": tuple(
                    MoverBox(int(m["id"]), np.array(m["box"], dtype=float).reshape(2, 3), float(m["speed"]))
                    for m in row["movers"]
                )
                for row in self.movers
            }

    @cached_property
    def thumbnails(self) -> dict[str, dict[str, bytes]]:
        """JPEG files by kind, by timestamp as text."""
        out: dict[str, dict[str, bytes]] = {}
        with damaged(DatasetError, self.folder / FOLDER):
            for path in (self.folder / FOLDER).glob("*.jpg"):
                stamp, _, kind = path.stem.rpartition(".")
                if kind in KINDS:
                    out.setdefault(stamp, {})[kind] = read_bytes(path, LARGEST_THUMBNAIL)
            return dict(sorted(out.items(), key=lambda item: float(item[0])))

    def figures(self) -> list[FrameFigures]:
        """Pose, moving objects and metrics of every frame, without residuals."""
        path = self.trajectory
        if not self.frames:  # merged maps have trajectories and no frames
            pairs = zip(path.timestamps.tolist(), path.Ts_world_camera, strict=True)
            return [FrameFigures(stamp, T, "", (), 0.0, np.nan, 0.0) for stamp, T in pairs]
        poses = {f"{t:.6f}": T for t, T in zip(path.timestamps, path.Ts_world_camera, strict=True)}
        with damaged(DatasetError, self.folder / "metrics.json"):
            reasons = {f"{row['timestamp']:.6f}": str(row["reason"]) for row in self.metrics.get("lost_frames", [])}
        return [
            FrameFigures(
                float(row["timestamp"]), poses.get(row["timestamp"]), reasons.get(row["timestamp"], ""),
                self.boxes.get(row["timestamp"], ()), float(row["total"]), np.nan, float(row["dynamic_share"]),
            )
            for row in self.frames
        ]  # fmt: skip
