"""A run folder as the viewers read it."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dudmap import __version__
from dudmap.app.viewing.snapshot import KINDS, MoverBox
from dudmap.app.viewing.thumbnails import FOLDER
from dudmap.core.geometry.mesh import Mesh, ply_layout
from dudmap.core.geometry.mesh_pieces import load_simplified
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DudmapError
from dudmap.input_files import DAMAGE, damaged, parse_json, read_bytes, read_json, read_text

NOT_STAGES = ("timestamp", "state", "fused", "dynamic_share", "reading", "total", "dropped", "latency")
"""Columns of timings.csv that are not the time of a stage."""
MAX_TRIANGLES = 5_000_000
"""Triangles of a mesh that a page or a window can hold; a larger one is simplified."""

LARGEST_THUMBNAIL = 2**22
"""Largest thumbnail, bytes; they have 10 to 30 kB."""


@dataclass(frozen=True, eq=False)
class RunFiles:
    """What a run folder holds for a viewer.

    Attributes:
        folder: The run folder.
        metrics: Content of metrics.json.
        config: Text of config.toml, empty if there is none.
        trajectory: Poses of all tracked frames; without any if no frame was tracked.
        mesh: The mesh, simplified to ``MAX_TRIANGLES``; None if no frame was fused.
        frames: Rows of timings.csv: timestamp, state, times; one per processed frame.
        movers: Moving objects by the timestamp of the frame, as text with six decimals.
        thumbnails: JPEG files by kind of image, by the timestamp of the frame as text.
    """

    folder: Path
    metrics: dict[str, Any]
    config: str
    trajectory: Trajectory
    mesh: Mesh | None
    frames: list[dict[str, str]]
    movers: dict[str, list[MoverBox]]
    thumbnails: dict[str, dict[str, bytes]]

    @classmethod
    def load(cls, folder: str | Path) -> "RunFiles":
        """Read a run folder.

        Raises:
            DudmapError: The folder is none of a run, was written by a newer version, or a file in it is damaged.
        """
        folder = Path(folder)
        with damaged(DudmapError, f"the run folder {folder}"):
            metrics, path = _metrics(folder), folder / "trajectory.txt"
            tracked = metrics.get("tracked") and path.is_file()
            mesh, config = folder / "mesh.ply", folder / "config.toml"
            return cls(
                folder,
                metrics,
                config=read_text(config) if config.is_file() else "",
                trajectory=Trajectory.load(path) if tracked else Trajectory.from_poses([]),
                mesh=_mesh(mesh) if mesh.is_file() and metrics.get("mesh_triangles") else None,
                frames=_frames(folder / "timings.csv"),
                movers=_movers(folder / "movers.jsonl"),
                thumbnails=_thumbnails(folder / FOLDER),
            )

    @property
    def stages(self) -> list[str]:
        """Names of the stages of processing, in the order of the columns of timings.csv."""
        return [key for key in self.frames[0] if key not in NOT_STAGES] if self.frames else []

    def column(self, name: str) -> np.ndarray:
        """Column of timings.csv, one number per processed frame."""
        return np.array([float(row[name] or 0) for row in self.frames])


def _mesh(path: Path) -> Mesh:
    """The mesh of a run; a very large one is simplified as it is read, so that it need not fit into the memory."""
    layout = ply_layout(path)
    large = layout is not None and len(layout[1]) > MAX_TRIANGLES
    return load_simplified(path, MAX_TRIANGLES) if large else Mesh.load(path)


def _metrics(folder: Path) -> dict[str, Any]:
    path = folder / "metrics.json"
    if not folder.is_dir():
        raise DudmapError(f"there is no run folder {folder}; `dudmap run RECORDING --out {folder}` would write it")
    if not path.is_file():
        raise DudmapError(f"{folder} is no complete run folder: it has no metrics.json; name one of `dudmap run`")
    try:
        metrics = read_json(path)
        version = str(metrics["versions"]["dudmap"])
    except DAMAGE as error:
        raise DudmapError(f"{path} is damaged or not of `dudmap run` ({error!r}); run again") from None
    if _release(version) > _release(__version__):
        raise DudmapError(f"{folder} was written by dudmap {version}, newer than this {__version__}; upgrade dudmap")
    return metrics


def _release(version: str) -> tuple[int, ...]:
    """Major and minor number of a version."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])


def _frames(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    rows = list(csv.DictReader(read_text(path).splitlines()))
    numbers = [name for name in (rows[0] if rows else ()) if name not in ("state", "fused")]
    for number, row in enumerate(rows, start=2):
        try:
            _ = [float(row[name]) for name in ("timestamp", "total", "dynamic_share")]
            _ = [float(row[name] or 0) for name in numbers]
        except DAMAGE as error:
            raise DudmapError(f"{path}, line {number} is damaged ({error!r}); run again") from None
    return rows


def _movers(path: Path) -> dict[str, list[MoverBox]]:
    out: dict[str, list[MoverBox]] = {}
    if not path.is_file():
        return out
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        try:
            row = parse_json(line)
            boxes = [MoverBox(int(m["id"]), np.array(m["box"], dtype=float), float(m["speed"])) for m in row["movers"]]
            out[f"{row['timestamp']:.6f}"] = boxes
        except DAMAGE as error:
            raise DudmapError(f"{path}, line {number} is damaged ({error!r}); run again") from None
    return out


def _thumbnails(folder: Path) -> dict[str, dict[str, bytes]]:
    out: dict[str, dict[str, bytes]] = {}
    for path in folder.glob("*.jpg"):
        stamp, _, kind = path.stem.rpartition(".")
        if kind in KINDS:
            out.setdefault(stamp, {})[kind] = read_bytes(path, LARGEST_THUMBNAIL)
    return dict(sorted(out.items(), key=lambda item: float(item[0])))
