"""What can be chosen about an export."""

from dataclasses import dataclass, fields
from pathlib import Path

from dudmap.errors import ConfigError

Box = tuple[float, float, float, float, float, float]
MESH_OPTIONS = ("max_triangles", "crop", "drop_pieces_below", "fill_holes")
"""Options that change the mesh."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; each format takes some of them.

    Attributes:
        max_triangles: Largest number of triangles.
        crop: Lower and upper corner of the part of the map to keep, metres, world frame.
        drop_pieces_below: Connected pieces of the mesh with a smaller surface are left out, square metres; None leaves
            out those less than 2 cm across.
        fill_holes: Holes whose border is at most so long are closed, metres.
        up: Direction against gravity in the world frame; None for the normal of the floor in the map.
        resolution: Edge of the cells of grids, metres.
        heights: Lower and upper end of the robot above the floor, metres.
        sequence: Recording that the run was made from; None for the one that the run names.
        camera: Intrinsics of that recording, as ``--camera`` takes them; None for those of the run.
        every: Every so many frames of the recording are exported.
    """

    max_triangles: int | None = None
    crop: Box | None = None
    drop_pieces_below: float | None = None
    fill_holes: float | None = None
    up: tuple[float, float, float] | None = None
    resolution: float = 0.05
    heights: tuple[float, float] = (0.1, 1.8)
    sequence: Path | None = None
    camera: str | None = None
    every: int = 1

    def check(self, taken: tuple[str, ...], name: str) -> None:
        """Check that only options are set that a format takes.

        Raises:
            ConfigError: Another one is set.
        """
        for field in fields(self):
            if getattr(self, field.name) != field.default and field.name not in taken:
                known = ", ".join(option_name(option) for option in taken) or "no option"
                raise ConfigError(f"{name} does not take {option_name(field.name)}; it takes {known}")


def option_name(field: str) -> str:
    """Name of an option on the command line."""
    return "--" + field.replace("_", "-")
