"""The run folder: lock, cleaning, and all result files."""

import json
import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.app.pipeline.environment import machine, peak_rss_mb, versions
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.observer import command_line
from dudmap.app.pipeline.storing import FILES as STATE_FILES
from dudmap.app.pipeline.usefulness import uselessness
from dudmap.atomic_file import UNFINISHED, write_image, write_text, writing
from dudmap.config import Config
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_pieces import save_pieces
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, DudmapError, MapError
from dudmap.evaluation.trajectory import accuracy
from dudmap.io.exporting.up import find_up
from dudmap.io.sequences import is_recording
from dudmap.own_folder import OwnFolder, make_folder, remove_files

if TYPE_CHECKING:
    from dudmap.app.pipeline.given_poses import GivenPoses
    from dudmap.core.objects.object_map import RigidObject
    from dudmap.core.slam import Slam
    from dudmap.io.cameras import LiveCamera
    from dudmap.io.sequences import Sequence

LOCK = ".lock"
LOCKED_BYTE = 1 << 20
"""Locked byte on Windows, behind the text."""

FILES = (
    "trajectory.txt", "image_poses.txt", "groundtruth.txt", "mesh.ply", "map.npz", "config.toml", "metrics.json",
    "timings.csv", "checks.csv", "residuals.npz", "movers.jsonl", "calibration.toml", "keyframes.npz",
    "merge.json", "report.html", "changes.jsonl", "ignored.png", "given_poses.txt",
)  # fmt: skip
IGNORED = "ignored.png"
FACES = 20_000
"""Triangles for the direction against gravity: a tenth of a second."""
SCORES = (
    "evaluation.json", "evaluation.md", "evaluation.csv", "evaluation.tex", "mesh.evaluation.json",
    "masks.evaluation.json", "timings.evaluation.json", "timings.tex", "trajectory.png", "error.png", "path.png",
    "rpe.png", "residuals.png", "mesh_error.ply", "mesh_error.png", "masks.png",
)  # fmt: skip
WRITTEN = {
    "": "|".join((
        *map(re.escape, FILES + SCORES + STATE_FILES), r"trajectory-\d+\.txt", r"mesh-\d+\.ply", r"crash-[\d-]+\.txt",
    )),
    "masks": r"-?\d+\.\d{6}\.png", "movers": r"\d+\.(ply|txt)", "thumbnails": r"-?\d+\.\d{6}\.[a-z]+\.jpg",
    "images": r"-?\d+\.\d{6}\.(jpg|png)|(associations|intrinsics)\.txt",
}  # fmt: skip
"""File names of a run by sub-folder, regular expressions."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a run folder, at most until the process ends.

    Raises:
        DudmapError: Another holds the lock; the message names it.
        OSError: The file cannot be written or is no plain file.
    """
    with OwnFolder(folder, linked=True) as own, _locked_file(own) as file:
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": datetime.now().isoformat(" ", "seconds")}
        file.truncate(0)
        file.write(json.dumps(about).encode())
        file.flush()
        try:
            yield
        finally:
            if os.name == "posix":
                own.remove(LOCK)


def _locked_file(folder: OwnFolder) -> IO[bytes]:
    while True:
        file = os.fdopen(folder.open(LOCK, os.O_RDWR | os.O_CREAT), "r+b")
        try:
            _lock(file)
        except OSError:
            holder = file.read(1000).decode(errors="replace")
            file.close()
            raise DudmapError(
                f"{folder.path} is in use by {_described(holder)}; wait for it, end it, or name another folder"
            ) from None
        there = folder.status(LOCK)
        if there is not None and os.path.samestat(os.fstat(file.fileno()), there):
            return file
        file.close()  # the previous holder has removed this file meanwhile


def _lock(file: IO[bytes]) -> None:
    """Lock a file for this process; an ``OSError`` if it is locked."""
    if os.name == "nt":
        import msvcrt

        file.seek(LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        file.seek(0)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _described(holder: str) -> str:
    try:
        about = json.loads(holder)
        return f"process {int(about['pid'])} on {about['host']} since {about['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


@dataclass(frozen=True, eq=False)
class RunReport:
    """Result of a run."""

    out: Path
    metrics: dict[str, Any]
    trajectory: Trajectory


def save_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Write a mask (H, W), 255 = dynamic, on disk before the next checkpoint."""
    write_image(path, mask, sync=False, own=True)


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Lock the run folder; create it if needed and remove half-written files.

    Raises:
        DudmapError: Another process writes, or the folder cannot be created or written.
    """
    with ExitStack() as held:
        with writing(f"into the run folder {out}"):
            out.mkdir(parents=True, exist_ok=True)
            held.enter_context(run_lock(out))
            remove_files(out, dict.fromkeys(WRITTEN, UNFINISHED))
        yield


def prepare_run_folder(out: Path, masks: str | Path | None, *, save_masks: bool) -> None:
    """Remove earlier results from the ``locked`` run folder.

    Raises:
        DudmapError: It cannot be written, or holds the recording or masks to read.
    """
    if (out / "rgb.txt").exists() or (out / "depth.txt").exists() or is_recording(out):
        raise DudmapError(
            f"{out} holds a recording, whose ground truth and masks a run would overwrite; name another folder"
        )
    if masks is not None and (out / "masks").resolve() == Path(masks).resolve():
        raise DudmapError(f"the masks to be read lie in the run folder {out}, which is emptied; name another folder")
    with writing(f"into the run folder {out}"):
        remove_files(out, WRITTEN)
        if save_masks:
            make_folder(out / "masks")


def write_run_folder(
    out: Path,
    slam: "Slam",
    record: RunRecord,
    sequence: "Sequence | LiveCamera",
    config: Config,
    stopped: str,
    *,
    save_map: bool,
    defect: bool = False,
    poses: "GivenPoses | None" = None,
) -> RunReport:
    """Write all files of the run folder, in spite of failing ones.

    After a defect of dudmap, metrics.json lists them under ``not_written``, so that the first error is reported.

    Raises:
        DudmapError: A file failed, other than after a defect.
    """
    foreseen = Exception if defect else (OSError, MapError)
    calibration, maps = slam.calibration, slam.maps
    (trajectory, volume), *others = maps
    metrics: dict[str, Any] = {"sequence": sequence.name, "complete": not stopped, "stopped_by": stopped or None}
    metrics |= {"recording": getattr(sequence, "opened", None), "sources": getattr(sequence, "sources", {})}
    metrics |= record.metrics() | {
        "map_blocks": volume.num_blocks, "map_bytes": volume.num_bytes, "mesh_vertices": 0, "mesh_triangles": 0,
        "maps": len(others) + 1, "calibration": calibration.tree(),
        "calibration_waits": slam.calibration_waits,
    }  # fmt: skip

    if poses is not None:
        correction = poses.corrections(trajectory) if poses.role == "refined" else None
        metrics["poses"] = {"role": poses.role, "given": len(poses.trajectory), "correction": correction}

    thinned: list[Mesh] = []

    def save_mesh() -> None:
        if volume.pager is not None:  # the mesh may not fit into the memory
            vertices, triangles = save_pieces(volume.extract_pieces(), out / "mesh.ply")
        else:
            mesh = volume.extract_mesh()
            vertices, triangles = len(mesh.vertices), len(mesh.faces)
            mesh.save(out / "mesh.ply")
            thinned.append(replace(mesh, faces=mesh.faces[:: max(1, triangles // FACES)]))
        metrics.update(mesh_vertices=vertices, mesh_triangles=triangles)

    def find_direction() -> None:
        metrics["up"] = _up(sequence, trajectory, thinned[0] if thinned else None)

    def save_metrics() -> None:
        metrics["useless"] = None if slam.localize else uselessness(metrics, len(trajectory), config.depth_limits)
        if sequence.ground_truth is not None:
            metrics.update(accuracy(trajectory, sequence.ground_truth))
        about = {"versions": versions(), "machine": machine(), "device": slam.device, "peak_rss_mb": peak_rss_mb()}
        metrics.update(zip(("wall_s", "cpu_s"), (round(seconds, 3) for seconds in record.elapsed()), strict=True))
        about |= {"command": command_line(), "date": datetime.now().astimezone().isoformat(" ", "seconds")}
        metrics.update(camera=asdict(sequence.camera), **about)
        write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")

    steps: list[Callable[[], None]] = [
        lambda: trajectory.save(out / "trajectory.txt"),
        lambda: config.save(out / "config.toml"),
        lambda: calibration.save(out / "calibration.toml"),
        lambda: record.save_timings(out / "timings.csv"),
        lambda: record.save_checks(out / "checks.csv"),
        lambda: record.save_residuals(out / "residuals.npz"),
        lambda: record.save_movers(out / "movers.jsonl"),
    ]
    if calibration.depth_late:
        steps.append(lambda: slam.image_poses.save(out / "image_poses.txt"))
    if sequence.ground_truth is not None:
        truth = sequence.ground_truth
        steps.append(lambda: truth.save(out / "groundtruth.txt"))
    if not (volume.is_empty or slam.localize):
        steps.append(save_mesh)
        if save_map:
            steps.append(lambda: volume.save(out / "map.npz"))
            if config.system == "dudmap":
                steps.append(lambda: slam.saved_map.save_keyframes(out / "keyframes.npz"))
    steps.append(find_direction)
    for number, (path, part) in enumerate(others, start=2):
        steps += [
            partial(path.save, out / f"trajectory-{number}.txt"),
            lambda part=part, number=number: part.extract_mesh().save(out / f"mesh-{number}.ply"),
        ]
    if config.movers.meshes:
        steps.append(lambda: metrics.update(bodies=_save_objects(out / "movers", slam.rigid_objects)))
    problems = []
    try:
        for step in steps:
            try:
                step()
            except foreseen as error:
                problems.append(str(error) or repr(error))
    finally:
        if problems:
            metrics["not_written"] = problems
        save_metrics()
    if problems and not defect:
        raise DudmapError(f"the run folder {out} is incomplete: {problems[0]}")
    return RunReport(out, metrics, trajectory)


def _up(sequence: "Sequence | LiveCamera", poses: Trajectory, mesh: Mesh | None) -> dict[str, Any] | None:
    measured, problem = None, ""
    try:
        gravity = getattr(sequence, "gravity", None)
        measured = None if gravity is None else gravity.in_world(poses)
        if gravity is not None and measured is None:
            problem = f"gravity of {gravity.source} is not used: none of its times is near a pose"
    except DatasetError as error:
        problem = f"gravity is not used: {error}"
    if not len(poses):
        return None
    up = find_up(mesh, poses, measured)
    return (up._replace(contradiction=up.contradiction or problem)).metrics(measured)


def _save_objects(folder: Path, objects: "list[RigidObject]") -> list[dict[str, Any]]:
    out = []
    for obj in objects:
        row = {"id": obj.id, "rigid": obj.rigid, "why_not": obj.reason or None, "frames": obj.frames}
        if obj.mesh is not None and obj.trajectory is not None:
            make_folder(folder)
            obj.mesh.save(folder / f"{obj.id}.ply")
            obj.trajectory.save(folder / f"{obj.id}.txt")
            row["mesh_triangles"] = len(obj.mesh.faces)
        out.append(row)
    return out
