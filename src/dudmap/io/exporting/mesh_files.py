"""Meshes as PLY, OBJ and STL, in the axes of the map."""

from pathlib import Path

from dudmap.io.exporting.mesh_editing import edited
from dudmap.io.exporting.options import ExportOptions
from dudmap.io.exporting.run_content import RunContent


def _write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the mesh in the format of the file's ending.

    Raises:
        MapError: There is no mesh, or the file cannot be written.
        ConfigError: An option is invalid.
    """
    edited(run.surface, options).save(path)


write_ply = write_obj = write_stl = _write
