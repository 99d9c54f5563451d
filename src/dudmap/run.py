"""A run: frames go in, a run folder comes out. No algorithm in it."""

import json
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError, DudmapError, FrameError, MapError
from dudmap.frame import Frame
from dudmap.metrics import RunRecord, accuracy, machine, versions
from dudmap.progress import RunProgress
from dudmap.trajectory import Trajectory

if TYPE_CHECKING:
    from dudmap.bodies import Body
    from dudmap.result import FrameResult
    from dudmap.sequences import Sequence
    from dudmap.sequences.masks import MaskFolder
    from dudmap.slam import Prepared, Slam

AHEAD = 4
"""Frames of a recording on disk that are read while an earlier one is processed."""
FILES = (
    "trajectory.txt", "groundtruth.txt", "mesh.ply", "map.npz", "config.toml", "metrics.json", "timings.csv",
    "residuals.npz", "movers.jsonl",
)  # fmt: skip
SCORES = (
    "evaluation.json", "mesh.evaluation.json", "masks.evaluation.json", "trajectory.png", "error.png", "rpe.png",
    "residuals.png", "mesh_error.ply", "mesh_error.png", "masks.png",
)  # fmt: skip
"""What `dudmap evaluate` writes beside a run; it would not belong to the next one."""


@dataclass(frozen=True, eq=False)
class RunReport:
    """What a run gave.

    Attributes:
        out: The run folder.
        metrics: The content of metrics.json.
        trajectory: Poses of all tracked frames.
    """

    out: Path
    metrics: dict[str, Any]
    trajectory: Trajectory


class Reading(NamedTuple):
    """What the reader found.

    Attributes:
        frame: The frame, or why there is none.
        mask: (H, W) its true dynamic mask, None if not known, or why it cannot be read.
        ms: Reading time of the frame.
        known: (H, W) what a mask from outside says moves, None if there is none, or why it cannot be read.
        prepared: The frame as the system takes it, where it was made ready ahead.
    """

    frame: Frame | FrameError
    mask: NDArray[np.bool_] | FrameError | None
    ms: float
    known: NDArray[np.bool_] | FrameError | None = None
    prepared: "Prepared | None" = None


class Turn(NamedTuple):
    """A frame whose turn it is.

    Attributes:
        number: Its number.
        reading: What was read.
        dropped: Frames that were dropped since the one before.
        arrival: When it arrived, seconds of ``time.perf_counter``; None where frames wait for the system.
    """

    number: int
    reading: Reading
    dropped: int = 0
    arrival: float | None = None


def run(
    sequence: "Sequence",
    config: Config,
    out: str | Path,
    *,
    max_frames: int | None = None,
    save_masks: bool = False,
    save_map: bool = True,
    masks: str | Path | None = None,
    progress: bool = True,
    ahead: int = AHEAD,
    live: bool = False,
    passes: int = 1,
    observe: "Callable[[int, Reading, FrameResult], None] | None" = None,
) -> RunReport:
    """Run the system over a recording and write a run folder.

    The folder gets trajectory.txt (TUM format, one line per tracked frame), mesh.ply, map.npz, config.toml,
    metrics.json, timings.csv, residuals.npz (histogram of the residuals and the mixture fitted to it),
    movers.jsonl (one JSON object per frame with moving bodies: timestamp and, of each body, id, centroid, box,
    velocity, speed and pixels; metres, m/s, world frame), the true trajectory as groundtruth.txt where it is known
    and, if asked for, masks/<timestamp>.png (255 = dynamic) and movers/<id>.ply and .txt, mesh and poses of every rigid
    moving body (``movers.meshes``). Where the camera was lost and what it showed then was
    never joined with the rest, the largest map is written, and the others as trajectory-2.txt and mesh-2.ply and so on,
    each in a world of its own. Results of an earlier run in the same folder are removed first. If anything stops the
    run, what was computed so far is written all the same.

    Args:
        sequence: The recording; its ground truth and masks are used for scoring only.
        config: All parameters.
        out: The run folder; made if needed.
        max_frames: Stop after this many frames.
        save_masks: Write the dynamic mask of every frame.
        save_map: Write map.npz.
        masks: Folder of masks from outside, <timestamp>.png with 255 = moves; they are added to what is found. Frames
            without one are counted.
        progress: Show a progress bar on a terminal.
        ahead: Frames that are read while an earlier one is processed; 0 where reading is work for all cores, as with
            rendered frames, and would disturb the times. The result does not depend on it.
        live: Frames arrive as their times tell, from when the kernels are loaded; the newest that has arrived is
            processed, and those that there is no time for are dropped and counted. Nothing queues.
        passes: 2 goes over the recording twice: the second time every frame is compared with the map of the whole
            first time, so that people at the start leave the map too. What is written is the last finished pass.
        observe: Called after each processed frame with its number, reading and result.

    Raises:
        ConfigError: ``passes`` is not 1 or 2, or 2 with ``live``.
        DudmapError: The folder cannot be written, the recording cannot be used, or no frame could be tracked.
        KeyboardInterrupt: ctrl-C, after writing; the message says what is saved where.
    """
    from dudmap.slam import Slam

    out = Path(out)
    count = len(sequence) if max_frames is None else min(max_frames, len(sequence))
    if count < 1:
        raise DatasetError(
            f"{sequence.name} has {len(sequence)} frames and {max_frames} are wanted; expected one or more"
        )
    if passes not in (1, 2) or (live and passes == 2):
        raise ConfigError(
            f"found passes = {passes}{' of a live run' if live else ''}; expected 1, or 2 for a recording at rest"
        )
    known = None if masks is None else _open_masks(masks, sequence)
    slam = Slam(sequence.camera, config)
    record = RunRecord(masked=None if masks is None else 0, dropped=0 if live else None)
    finished: tuple[Slam, RunRecord] | None = None
    _prepare(out, masks, save_masks=save_masks)
    stopped = ""
    with RunProgress(count * passes, bar=progress) as display:
        try:
            if live:
                display.working("loading kernels")
                _load_kernels(Slam(sequence.camera, config), sequence, count)
            for number in range(passes):
                if number > 0:
                    finished = slam, record
                    slam = Slam(sequence.camera, config, first_pass=slam)
                    record = RunRecord(masked=record.masked and 0, dropped=None)
                last = number == passes - 1
                with closing(
                    _live(sequence, count, known) if live else _waiting(sequence, count, ahead, known, slam)
                ) as turns:
                    for turn in turns:
                        _process(
                            turn, slam, record, display, out if save_masks and last else None, observe if last else None
                        )
            if len(slam.maps) > 1:
                display.note(_apart(slam))
            if record.dropped:
                display.note(f"live: {record.dropped} of {count} frames dropped; the newest was always taken")
        except KeyboardInterrupt:
            stopped = f"interrupted after {len(record.rows)} frames{_of_second(finished)}"
            raise KeyboardInterrupt(f"{stopped}; {_saved(finished)} in {out}") from None
        except DudmapError as error:
            stopped = str(error)
            raise type(error)(f"{stopped}; {_saved(finished)} in {out}") from error
        except BaseException as error:
            stopped = repr(error)
            raise
        finally:
            display.working("writing")
            if stopped and finished is not None:  # the first pass is whole, the second is not
                slam, record = finished
            report = _write(out, slam, record, sequence, config, stopped, save_map=save_map)
    if record.rows and not len(report.trajectory):
        raise DudmapError(f"none of the {count} frames could be tracked; the first: {record.lost[0]['reason']}")
    if not record.rows:
        raise DatasetError(f"none of the {count} frames could be read; the first: {record.unreadable[0]}")
    return report


def _apart(slam: "Slam") -> str:
    """Sentence on maps that are not connected."""
    main, *others = (len(trajectory) for trajectory, _ in slam.maps)
    names = " and ".join(f"mesh-{number}.ply ({count} frames)" for number, count in enumerate(others, start=2))
    return f"places were not recognised after a loss: the main map has {main} frames; beside it there is {names}"


def _of_second(finished: object) -> str:
    return " of the second pass" if finished else ""


def _saved(finished: object) -> str:
    whole = "the trajectory and the map of the first pass are"
    return whole if finished else "the trajectory and the map up to there are"


def _open_masks(folder: str | Path, sequence: "Sequence") -> "MaskFolder":
    from dudmap.sequences.masks import MaskFolder

    return MaskFolder(folder, sequence.timestamps, sequence.camera)


def read_ahead(
    sequence: "Sequence", count: int, ahead: int = AHEAD, known: "MaskFolder | None" = None, slam: "Slam | None" = None
) -> "Generator[Reading]":
    """The first ``count`` frames in order, read and made ready for ``slam`` by one thread up to ``ahead`` ahead."""
    reader = ThreadPoolExecutor(1, thread_name_prefix="dudmap-reader")
    pending: deque[Future[Reading]] = deque()
    try:
        for index in range(count + ahead):
            if index < count:
                pending.append(reader.submit(_read, sequence, index, known, slam))
            if index >= ahead:
                yield pending.popleft().result()
    finally:
        reader.shutdown(cancel_futures=True)


def _waiting(
    sequence: "Sequence", count: int, ahead: int, known: "MaskFolder | None", slam: "Slam"
) -> "Generator[Turn]":
    for index, reading in enumerate(read_ahead(sequence, count, ahead, known, slam if ahead else None)):
        yield Turn(index, reading)


def _live(sequence: "Sequence", count: int, known: "MaskFolder | None") -> "Generator[Turn]":
    from dudmap.live import live

    last = -1
    with closing(live(sequence.timestamps[:count], lambda index: _read(sequence, index, known))) as arrivals:
        for arrival in arrivals:
            yield Turn(arrival.number, arrival.item, arrival.number - last - 1, arrival.time)
            last = arrival.number


def _load_kernels(slam: "Slam", sequence: "Sequence", count: int) -> None:
    """Run the first frames through a system that is thrown away: a sensor is switched on when all is compiled."""
    for index in range(min(count, 3)):
        frame = _read(sequence, index).frame
        if not isinstance(frame, FrameError):
            slam.process(frame)


def _read(sequence: "Sequence", index: int, masks: "MaskFolder | None" = None, slam: "Slam | None" = None) -> Reading:
    start = time.perf_counter()
    try:
        frame: Frame | FrameError = sequence[index]
    except FrameError as error:
        return Reading(error, None, 1000 * (time.perf_counter() - start))
    ms = 1000 * (time.perf_counter() - start)
    prepared = None if slam is None else slam.prepare(frame)
    return Reading(frame, _or_error(sequence.mask, index), ms, masks and _or_error(masks.__getitem__, index), prepared)


def _or_error(read: Callable[[int], NDArray[np.bool_] | None], index: int) -> NDArray[np.bool_] | FrameError | None:
    try:
        return read(index)
    except FrameError as error:
        return error


def _process(
    turn: Turn,
    slam: "Slam",
    record: RunRecord,
    display: RunProgress,
    out_of_masks: Path | None,
    observe: "Callable[[int, Reading, FrameResult], None] | None",
) -> None:
    index, reading = turn.number, turn.reading
    if record.dropped is not None:
        record.dropped += turn.dropped
    if isinstance(reading.frame, FrameError):
        record.unreadable.append(str(reading.frame))
        display.note(f"skipped: {reading.frame}")
        return
    truth = reading.mask
    if isinstance(truth, FrameError):
        display.note(f"frame {index}: its mask is not scored, {truth}")
        truth = None
    known = reading.known
    if isinstance(known, FrameError):
        display.note(f"frame {index}: its mask is left out, {known}")
        known = None
    if record.masked is not None:
        record.masked += known is not None
    start = time.perf_counter()
    frame = reading.prepared or reading.frame
    result = slam.process(frame) if known is None else slam.process(frame, known)
    end = time.perf_counter()
    delays = {} if turn.arrival is None else {"dropped": turn.dropped, "latency": 1000 * (end - turn.arrival)}
    record.add(result, 1000 * (end - start), reading.ms, truth, **delays)
    if out_of_masks is not None:
        _save_mask(out_of_masks / "masks" / f"{result.timestamp:.6f}.png", result.dynamic_mask)
    if observe is not None:
        observe(index, reading, result)
    display.frame(index, result, record.dropped)


def _save_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    import cv2

    path.write_bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())


def _prepare(out: Path, masks: str | Path | None, *, save_masks: bool) -> None:
    """Make the run folder, prove that it can be written, and remove an earlier run's results and their scores.

    Raises:
        DudmapError: It cannot be made or written, or what is to be removed is a recording or the masks to be read.
    """
    if (out / "rgb.txt").exists() or (out / "depth.txt").exists():
        raise DudmapError(f"{out} holds a recording, whose truth and masks a run would overwrite; name another folder")
    if masks is not None and (out / "masks").resolve() == Path(masks).resolve():
        raise DudmapError(f"the masks to be read lie in the run folder {out}, which is emptied; name another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".dudmap-probe"
        probe.write_bytes(b"")
        probe.unlink()
        for name in FILES + SCORES:
            (out / name).unlink(missing_ok=True)
        for mask in (out / "masks").glob("*.png"):
            mask.unlink()
        parts = "trajectory-[0-9]*.txt", "mesh-[0-9]*.ply", "movers/[0-9]*.ply", "movers/[0-9]*.txt"
        for part in (path for pattern in parts for path in out.glob(pattern)):
            part.unlink()
        if save_masks:
            (out / "masks").mkdir(exist_ok=True)
    except OSError as error:
        raise DudmapError(f"cannot write into the run folder {out}: {error.strerror or error}") from error


def _write(
    out: Path,
    slam: "Slam",
    record: RunRecord,
    sequence: "Sequence",
    config: Config,
    stopped: str,
    *,
    save_map: bool,
) -> RunReport:
    """Write all files of the run folder; one that fails does not keep the others from being written.

    Raises:
        DudmapError: A file could not be written.
    """
    (trajectory, volume), *others = slam.maps
    metrics: dict[str, Any] = {"sequence": sequence.name, "complete": not stopped, "stopped_by": stopped or None}
    metrics |= record.metrics()
    sizes = {"map_blocks": volume.num_blocks, "map_bytes": volume.num_bytes}
    metrics |= sizes | {"mesh_vertices": 0, "mesh_triangles": 0}
    metrics["maps"] = len(others) + 1
    metrics["depth_delay_ms"] = 1000 * slam.registration.delay.seconds

    def save_mesh() -> None:
        mesh = volume.extract_mesh()
        metrics.update(mesh_vertices=len(mesh.vertices), mesh_triangles=len(mesh.faces))
        mesh.save(out / "mesh.ply")

    def save_metrics() -> None:
        if sequence.ground_truth is not None:
            metrics.update(accuracy(trajectory, sequence.ground_truth))
        metrics.update(camera=asdict(sequence.camera), versions=versions(), machine=machine())
        metrics["peak_rss_mb"] = record.metrics()["peak_rss_mb"]
        (out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")

    steps: list[Callable[[], None]] = [
        lambda: trajectory.save(out / "trajectory.txt"),
        lambda: config.save(out / "config.toml"),
        lambda: record.save_timings(out / "timings.csv"),
        lambda: record.save_residuals(out / "residuals.npz"),
        lambda: record.save_movers(out / "movers.jsonl"),
    ]
    if sequence.ground_truth is not None:
        truth = sequence.ground_truth
        steps.append(lambda: truth.save(out / "groundtruth.txt"))
    if not volume.is_empty:
        steps.append(save_mesh)
        if save_map:
            steps.append(lambda: volume.save(out / "map.npz"))
    for number, (path, part) in enumerate(others, start=2):
        steps += [
            partial(path.save, out / f"trajectory-{number}.txt"),
            lambda part=part, number=number: part.extract_mesh().save(out / f"mesh-{number}.ply"),
        ]
    if config.movers.meshes:
        steps.append(lambda: metrics.update(bodies=_save_bodies(out / "movers", slam.bodies)))
    problems = []
    try:
        for step in steps:
            try:
                step()
            except (OSError, MapError) as error:
                problems.append(str(error))
    finally:
        save_metrics()
    if problems:
        raise DudmapError(f"the run folder {out} is incomplete: {problems[0]}")
    return RunReport(out, metrics, trajectory)


def _save_bodies(folder: Path, bodies: "list[Body]") -> list[dict[str, Any]]:
    """Write mesh and trajectory of every rigid body; what metrics.json says of all of them."""
    out = []
    for body in bodies:
        row = {"id": body.id, "rigid": body.rigid, "why_not": body.why or None, "frames": body.frames}
        if body.mesh is not None and body.trajectory is not None:
            folder.mkdir(exist_ok=True)
            body.mesh.save(folder / f"{body.id}.ply")
            body.trajectory.save(folder / f"{body.id}.txt")
            row["mesh_triangles"] = len(body.mesh.faces)
        out.append(row)
    return out
