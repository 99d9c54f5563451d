"""Trajectories as other programs read them: poses camera to world, in the axes of the map."""

from pathlib import Path

from dudmap.atomic_file import write_text
from dudmap.core.geometry import se3
from dudmap.io.exporting.options import ExportOptions
from dudmap.io.exporting.run_content import RunContent

EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)  # fmt: skip


def write_tum(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw``, one pose a line."""
    run.trajectory.save(path)


def write_kitti(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write the upper three rows of each pose, 12 numbers a line; the format has no times."""
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
