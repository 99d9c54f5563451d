"""A run: frames go in, a run folder comes out. No algorithm in it."""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError, DudmapError, FrameError
from dudmap.pipeline.frame_source import AHEAD, Reading, Turn, as_they_come, in_order, load_kernels
from dudmap.pipeline.metrics import RunRecord
from dudmap.pipeline.progress import RunProgress
from dudmap.pipeline.run_folder import RunReport, make, save_mask, write

if TYPE_CHECKING:
    from dudmap.result import FrameResult
    from dudmap.sequences import Sequence
    from dudmap.sequences.masks import MaskFolder
    from dudmap.slam import Slam


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
    make(out, masks, save_masks=save_masks)
    stopped = ""
    with RunProgress(count * passes, bar=progress) as display:
        try:
            if live:
                display.working("loading kernels")
                load_kernels(Slam(sequence.camera, config), sequence, count)
            for number in range(passes):
                if number > 0:
                    finished = slam, record
                    slam = Slam(sequence.camera, config, first_pass=slam)
                    record = RunRecord(masked=record.masked and 0, dropped=None)
                last = number == passes - 1
                with closing(
                    as_they_come(sequence, count, known) if live else in_order(sequence, count, ahead, known, slam)
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
            report = write(out, slam, record, sequence, config, stopped, save_map=save_map)
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
        save_mask(out_of_masks / "masks" / f"{result.timestamp:.6f}.png", result.dynamic_mask)
    if observe is not None:
        observe(index, reading, result)
    display.frame(index, result, record.dropped)
