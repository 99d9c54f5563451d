"""Table of exporters by suffix or name of the target. Trajectories as text."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from dudmap.atomic_file import write_text
from dudmap.core.geometry import se3
from dudmap.errors import ConfigError
from dudmap.io.exporting.run_content import MESH_OPTIONS, ExportOptions, RunContent


@dataclass(frozen=True)
class Exporter:
    """A format that results can be written in.

    Attributes:
        summary: Content, for the help page.
        target: ``module:function`` of a function ``write(run, path, options) -> None``, imported on use.
        options: Fields of ``ExportOptions`` that it takes.
    """

    summary: str
    target: str
    options: tuple[str, ...] = ()

    @property
    def write(self) -> Callable[[RunContent, Path, ExportOptions], None]:
        """Function that writes a run; errors as in ``export_run``."""
        module, _, name = self.target.partition(":")
        return getattr(import_module(f"dudmap.io.exporting.{module}"), name)


_UPRIGHT = ("up", "z_up")
_MESH = (*MESH_OPTIONS, *_UPRIGHT)
_TEXTURE = ("texture", "sequence", "camera", "every")
_POINTS = ("crop", "drop_pieces_below", *_UPRIGHT)
_GRID = ("crop", "drop_pieces_below", "up", "resolution")
_VIEWS = ("crop", "drop_pieces_below", "sequence", "camera", "every")
EXPORTERS: dict[str, Exporter] = {
    ".ply": Exporter("mesh", "mesh_files:write", _MESH),
    ".obj": Exporter("mesh", "mesh_files:write_obj", (*_MESH, *_TEXTURE)),
    ".stl": Exporter("mesh without colours", "mesh_files:write", _MESH),
    ".glb": Exporter("mesh for browsers and Blender, y up", "mesh_files:write_glb", (*MESH_OPTIONS, "up", *_TEXTURE)),
    ".usdz": Exporter("mesh for USD programs, y up", "mesh_files:write_usdz", (*MESH_OPTIONS, "up", *_TEXTURE)),
    ".points.ply": Exporter("point cloud", "mesh_files:write_ply", _POINTS),
    ".pcd": Exporter("point cloud of PCL", "mesh_files:write_pcd", _POINTS),
    ".laz": Exporter("point cloud, compressed LAS 1.4", "mesh_files:write_laz", _POINTS),
    ".e57": Exporter("point cloud, ASTM E57", "mesh_files:write_e57", _POINTS),
    ".npz": Exporter("occupancy and distance grids (ESDF), z up", "grids:write_npz", _GRID),
    "map.yaml": Exporter("2D occupancy map for nav2, with map.pgm", "grids:write_nav2", (*_GRID, "heights")),
    "transforms.json": Exporter("folder for nerfstudio", "view_synthesis:write_nerfstudio", _VIEWS),
    "cameras.txt": Exporter("folder in COLMAP's text format", "view_synthesis:write_colmap", _VIEWS),
    ".tum": Exporter("trajectory, TUM", "exporters:write_tum", _UPRIGHT),
    ".kitti": Exporter("trajectory, KITTI", "exporters:write_kitti", _UPRIGHT),
    ".csv": Exporter("trajectory, EuRoC", "exporters:write_euroc", _UPRIGHT),
    ".mcap": Exporter("ROS 2 messages (tf, odometry, path, points, mesh, movers), for Foxglove", "ros_messages:write"),
}


def find_exporter(name: str) -> Exporter:
    """Exporter for a file name.

    Raises:
        ConfigError: The suffix is unknown.
    """
    found = [key for key in EXPORTERS if (name.lower().endswith(key) if key.startswith(".") else name == key)]
    if not found:
        raise ConfigError(f"cannot export to {name!r}; the ending or name must be one of {', '.join(EXPORTERS)}")
    return EXPORTERS[max(found, key=len)]


def export_run(folder: str | Path, to: str | Path, options: ExportOptions | None = None) -> Path:
    """Write the results of a run folder in the format of the name ``to``; return the path.

    Raises:
        ConfigError: The suffix is unknown, an option does not fit, or a library is missing.
        DatasetError: The folder is no run folder, incomplete, or newer.
        MapError: The map or the mesh cannot be read, or is empty.
        OSError: The file cannot be written.
    """
    to, options = Path(to), options or ExportOptions()
    exporter = find_exporter(to.name)
    options.check(exporter.options, to.name)
    run = RunContent.load(folder)
    if options.z_up:
        from dudmap.io.exporting.up import upright

        run, options = upright(run, options)
    to.parent.mkdir(parents=True, exist_ok=True)
    exporter.write(run, to, options)
    return to


EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)  # fmt: skip


def write_tum(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw``, one pose a line."""
    run.trajectory.save(path)


def write_kitti(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the upper three rows of each pose, 12 numbers a line, without times."""
    rows = [" ".join(f"{number:.9f}" for number in T[:3].reshape(-1)) for T in run.trajectory.Ts_world_camera]
    write_text(path, "\n".join(rows) + "\n")


def write_euroc(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the columns of EuRoC's ``state_groundtruth_estimate0/data.csv`` up to the orientation."""
    lines = [EUROC_HEADER]
    for stamp, T in zip(run.trajectory.timestamps, run.trajectory.Ts_world_camera, strict=True):
        x, y, z, w = se3.rotation_to_quat_xyzw(T[:3, :3])
        numbers = (*T[:3, 3], w, x, y, z)
        lines.append(f"{round(stamp * 1e9)}," + ",".join(f"{number:.9f}" for number in numbers))
    write_text(path, "\n".join(lines) + "\n")
