"""The results in a run folder, as exporters take them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dudmap.errors import DatasetError
from dudmap.geometry.mesh import Mesh
from dudmap.geometry.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class RunContent:
    """Results of a run.

    Attributes:
        folder: The run folder.
        trajectory: Poses of the tracked frames.
        mesh: The static surface, None if there is none (a run that only localised).
        movers: Moving objects by frame, as in movers.jsonl.
    """

    folder: Path
    trajectory: Trajectory
    mesh: Mesh | None
    movers: list[dict[str, Any]]

    @classmethod
    def load(cls, folder: str | Path) -> "RunContent":
        """Read a run folder.

        Raises:
            DatasetError: The folder is no run folder, or a file is damaged.
            MapError: The mesh cannot be read.
        """
        folder = Path(folder)
        if not (folder / "trajectory.txt").is_file():
            raise DatasetError(f"{folder} holds no trajectory.txt; name a run folder, as dudmap run writes it")
        mesh = Mesh.load(folder / "mesh.ply") if (folder / "mesh.ply").is_file() else None
        return cls(folder, Trajectory.load(folder / "trajectory.txt"), mesh, _movers(folder / "movers.jsonl"))


def _movers(path: Path) -> list[dict[str, Any]]:
    """Lines of movers.jsonl; none if there is no file."""
    if not path.is_file():
        return []
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}; repeat the run") from error
