"""A run folder in the window."""

from pathlib import Path

import numpy as np

from dudmap.app.viewing.mesh_feed import MeshChanges
from dudmap.app.viewing.run_files import RunFiles
from dudmap.app.viewing.snapshot import FrameFigures
from dudmap.app.viewing.window import Window
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.errors import DudmapError
from dudmap.input_files import damaged

TRIANGLES = 1_000_000
"""Triangles that are sent to the browser: 40 MB, which it loads within seconds."""


def open_run(folder: str | Path, host: str, port: int, token: str | None = None) -> Window:
    """Window that shows a run folder; the slider stands at the first frame.

    Raises:
        DudmapError: The folder is no complete run folder, viser is missing, or the port is in use.
    """
    run = RunFiles.load(folder)
    window = Window(host, port, str(run.metrics.get("sequence") or run.folder.name), token)
    show_run(window, run)
    return window


def show_run(window: Window, run: RunFiles) -> None:
    """Fill a window with the results of a run."""
    if "camera" in run.metrics:
        with damaged(DudmapError, run.folder / "metrics.json"):
            values = run.metrics["camera"]
            window.set_camera(Camera(**values | {"distortion": tuple(values.get("distortion", ()))}))
    if run.mesh is not None:
        window.show_mesh(MeshChanges({(0, 0, 0): simplified(run.mesh, TRIANGLES)}))
    window.stay()
    window.add_frames(frames_of(run))
    for stamp, images in run.thumbnails.items():
        window.add_images(float(stamp), images)
    window.show_frame(0)


def frames_of(run: RunFiles) -> list[FrameFigures]:
    """Pose, moving objects and figures of every processed frame; the residual of single frames is not stored."""
    if not run.frames:  # maps of several runs that were merged have trajectories and no frames
        pairs = zip(run.trajectory.timestamps.tolist(), run.trajectory.Ts_world_camera, strict=True)
        return [FrameFigures(stamp, T, "", (), 0.0, np.nan, 0.0) for stamp, T in pairs]
    poses = {f"{t:.6f}": T for t, T in zip(run.trajectory.timestamps, run.trajectory.Ts_world_camera, strict=True)}
    with damaged(DudmapError, run.folder / "metrics.json"):
        reasons = {f"{row['timestamp']:.6f}": str(row["reason"]) for row in run.metrics.get("lost_frames", [])}
    return [
        FrameFigures(
            float(row["timestamp"]), poses.get(row["timestamp"]), reasons.get(row["timestamp"], ""),
            tuple(run.movers.get(row["timestamp"], ())), float(row["total"]), np.nan, float(row["dynamic_share"]),
        )
        for row in run.frames
    ]  # fmt: skip
