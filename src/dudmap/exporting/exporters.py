"""The table of exporters: the ending of the target names the format."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from dudmap.errors import ConfigError
from dudmap.exporting.run_content import RunContent


@dataclass(frozen=True)
class Exporter:
    """A format that results can be written in.

    Attributes:
        summary: What the file holds, for the help page.
        module: Module with a function ``write(run: RunContent, path: Path) -> None``, imported when it is needed.
    """

    summary: str
    module: str

    @property
    def write(self) -> Callable[[RunContent, Path], None]:
        """Writes the results of a run."""
        return import_module(self.module).write


EXPORTERS: dict[str, Exporter] = {
    ".mcap": Exporter(
        "ROS 2 messages (tf, odometry, path, points, mesh, movers), for Foxglove", "dudmap.exporting.mcap"
    ),
}
"""Exporters by the ending of the file."""


def export_run(folder: str | Path, to: str | Path) -> Path:
    """Write the results of a run folder in the format that the ending of ``to`` names; returns the path.

    Raises:
        ConfigError: The ending is unknown, or the format needs a library that is not installed.
        DatasetError: The folder is no run folder.
        OSError: The file cannot be written.
    """
    to = Path(to)
    exporter = EXPORTERS.get(to.suffix.lower())
    if exporter is None:
        raise ConfigError(f"cannot export to {to.name!r}; the ending must be one of {', '.join(EXPORTERS)}")
    if not to.parent.is_dir():
        raise ConfigError(f"the folder {to.parent} of the export does not exist; create it")
    exporter.write(RunContent.load(folder), to)
    return to
