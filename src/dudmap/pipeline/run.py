"""Processing of a recording: reads frames, runs the SLAM system, records metrics and writes the run folder."""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.config import Config
from dudmap.errors import ConfigError, DatasetError, DudmapError, FrameError
from dudmap.pipeline.frame_source import AHEAD, FrameRead, SourceFrame, in_order, in_real_time, load_kernels
from dudmap.pipeline.metrics import RunRecord
from dudmap.pipeline.progress import RunProgress
from dudmap.pipeline.run_folder import RunReport, prepare_run_folder, save_mask, write_run_folder

if TYPE_CHECKING:
    from dudmap.geometry.calibration import Calibration
    from dudmap.pipeline.observer import RunObserver
    from dudmap.places.saved_map import SavedMap
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
    depth_model: str | Path | None = None,
    calibration: "Calibration | None" = None,
    saved_map: "SavedMap | None" = None,
    localize: bool = False,
    observe: "Callable[[int, FrameRead, FrameResult], None] | None" = None,
    observers: "tuple[RunObserver, ...]" = (),
) -> RunReport:
    """Run the system over a recording and write a run folder.

    The folder receives trajectory.txt (TUM format, one line per tracked frame), mesh.ply, map.npz and keyframes.npz
    (what a later run needs to go on in the map), config.toml,
    metrics.json, timings.csv, residuals.npz (histogram of the residuals and the mixture fitted to it), movers.jsonl
    (one JSON object per frame with moving objects: timestamp, and per object id, centroid, box, velocity, speed and
    pixels; metres, m/s, world frame), groundtruth.txt if the true trajectory is known, masks/<timestamp>.png (255 =
    dynamic) with ``save_masks``, and movers/<id>.ply and .txt, mesh and poses of every rigid moving object, with
    ``movers.meshes``. Submaps that could not be merged with the largest one are written as trajectory-2.txt and
    mesh-2.ply and so on, each in its own world frame. Results of an earlier run in the same folder are removed first.
    If the run is interrupted or fails, the results up to there are written.

    Args:
        sequence: The recording; its ground truth and masks are used for evaluation only.
        config: All parameters.
        out: The run folder; created if needed.
        max_frames: Process only this many frames.
        save_masks: Write the dynamic mask of every frame.
        save_map: Write map.npz and keyframes.npz.
        masks: Folder of external dynamic masks, <timestamp>.png with 255 = dynamic, which are added to the estimated
            ones. Frames with and without a mask are counted.
        progress: Show a progress bar on a terminal.
        ahead: Number of frames read ahead of the processed one; 0 for rendered frames, whose reading uses all cores and
            would distort the times. The result does not depend on it.
        live: Replay the recording in real time once the kernels are loaded: the latest frame that has arrived is
            processed; frames for which there is no time are dropped and counted.
        passes: 2 processes the recording twice: in the second pass every frame is compared with the final map of the
            first, so that objects that were in view from the start also leave the map. The last complete pass is
            written.
        depth_model: ``depth_model.npz`` of an earlier run with the same camera, applied to the depth of every frame.
        calibration: Of the colour camera; None takes that of the recording.
        saved_map: Map of an earlier run to go on in, which is taken over; all poses are given in its world frame.
        localize: Only find the camera in ``saved_map``; no map and no mesh is written.
        observe: Called after each processed frame with its number, what was read, and the result.
        observers: Told when a pass begins, of each processed frame of every pass, and when the run folder is written.

    Raises:
        ConfigError: ``passes`` is not 1 or 2, or 2 with ``live`` or ``saved_map``; ``localize`` without a
            ``saved_map``.
        DudmapError: The folder cannot be written, the recording cannot be used, or no frame could be tracked.
        KeyboardInterrupt: Ctrl-C, after writing; the message names what was saved.
    """
    from dudmap.calibration.depth_model import DepthModel
    from dudmap.slam import Slam

    out = Path(out)
    count = len(sequence) if max_frames is None else min(max_frames, len(sequence))
    if count < 1:
        raise DatasetError(
            f"{sequence.name} has {len(sequence)} frames and {max_frames} are wanted; expected one or more"
        )
    if passes not in (1, 2) or (live and passes == 2):
        raise ConfigError(
            f"found passes = {passes}{' of a live run' if live else ''}; expected 1, or 2 without live replay"
        )
    if saved_map is None and localize:
        raise ConfigError("there is nothing to localize in; name the run folder of a saved map (--map)")
    if saved_map is not None and passes == 2:
        raise ConfigError("found passes = 2 with a saved map, which is kept; expected 1 pass")
    given_masks = None if masks is None else _open_masks(masks, sequence)
    model = None if depth_model is None else DepthModel.load(Path(depth_model))
    calibration = calibration or sequence.calibration
    slam = Slam(
        sequence.camera, config, depth_model=model, calibration=calibration, live=live, saved_map=saved_map,
        localize=localize,
    )  # fmt: skip
    record = RunRecord(masked=None if masks is None else 0, dropped=0 if live else None)
    finished: tuple[Slam, RunRecord] | None = None
    prepare_run_folder(out, masks, save_masks=save_masks)
    stopped = ""
    with RunProgress(count * passes, bar=progress) as display:
        try:
            if live:
                display.working("loading kernels")
                load_kernels(Slam(sequence.camera, config, calibration=calibration), sequence, count)
            for number in range(passes):
                if number > 0:
                    finished = slam, record
                    slam = Slam(sequence.camera, config, first_pass=slam, depth_model=model, calibration=calibration)
                    record = RunRecord(masked=record.masked and 0, dropped=None)
                last = number == passes - 1
                for observer in observers:
                    observer.start(slam, out, count)
                with closing(
                    in_real_time(sequence, count, given_masks)
                    if live
                    else in_order(sequence, count, ahead, given_masks, slam)
                ) as frames:
                    for frame in frames:
                        process_source(
                            frame,
                            slam,
                            record,
                            display,
                            out if save_masks and last else None,
                            observe if last else None,
                            observers,
                        )
            if len(slam.maps) > 1:
                display.note(_unmerged_submaps(slam))
            if record.dropped:
                display.note(f"live: {record.dropped} of {count} frames were dropped")
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
            if stopped and finished is not None:  # the first pass is complete, the second is not
                slam, record = finished
            report = write_run_folder(out, slam, record, sequence, config, stopped, save_map=save_map)
            for observer in observers:
                observer.finish(out)
    if record.rows and not len(report.trajectory):
        raise DudmapError(f"none of the {count} frames could be tracked; the first: {record.lost[0]['reason']}")
    if not record.rows:
        raise DatasetError(f"none of the {count} frames could be read; the first: {record.unreadable[0]}")
    return report


def _unmerged_submaps(slam: "Slam") -> str:
    """Sentence on the submaps that could not be merged."""
    main, *others = (len(trajectory) for trajectory, _ in slam.maps)
    names = " and ".join(f"mesh-{number}.ply ({count} frames)" for number, count in enumerate(others, start=2))
    return f"{len(others)} submap(s) could not be merged: the main map has {main} frames; the others are {names}"


def _of_second(finished: object) -> str:
    return " of the second pass" if finished else ""


def _saved(finished: object) -> str:
    whole = "the trajectory and the map of the first pass are"
    return whole if finished else "the trajectory and the map up to there are"


def _open_masks(folder: str | Path, sequence: "Sequence") -> "MaskFolder":
    from dudmap.sequences.masks import MaskFolder

    return MaskFolder(folder, sequence.timestamps, sequence.camera)


def process_source(
    source: SourceFrame,
    slam: "Slam",
    record: RunRecord,
    display: RunProgress,
    mask_folder: Path | None,
    observe: "Callable[[int, FrameRead, FrameResult], None] | None",
    observers: "tuple[RunObserver, ...]" = (),
) -> None:
    """Process one frame, count it, save its mask, and report it."""
    index, read = source.number, source.read
    if record.dropped is not None:
        record.dropped += source.dropped
    if isinstance(read.frame, FrameError):
        record.skip(read.frame)
        display.note(f"skipped: {read.frame}")
        return
    true_mask = read.true_mask
    if isinstance(true_mask, FrameError):
        display.note(f"frame {index}: the true mask is not scored, {true_mask}")
        true_mask = None
    given_mask = read.given_mask
    if isinstance(given_mask, FrameError):
        display.note(f"frame {index}: the given mask is ignored, {given_mask}")
        given_mask = None
    if record.masked is not None:
        record.masked += given_mask is not None
    start = time.perf_counter()
    frame = read.prepared or read.frame
    try:
        result = slam.process(frame) if given_mask is None else slam.process(frame, given_mask)
    except FrameError as error:
        record.skip(error)
        display.note(f"skipped: {error}")
        return
    end = time.perf_counter()
    delays = {} if source.arrival is None else {"dropped": source.dropped, "latency": 1000 * (end - source.arrival)}
    record.add(result, 1000 * (end - start), read.ms, true_mask, **delays)
    if mask_folder is not None and not result.rejected:
        save_mask(mask_folder / "masks" / f"{result.timestamp:.6f}.png", result.dynamic_mask)
    if observe is not None:
        observe(index, read, result)
    for observer in observers:
        observer.frame(index, read, result, 1000 * (end - start))
    if result.calibrated:
        display.note(f"frame {index}: the colour camera is calibrated ({', '.join(slam.calibration.estimated)})")
    display.frame(index, result, record.dropped)
