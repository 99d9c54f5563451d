"""Process a recording or a camera and write the run folder."""

import logging
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from dudmap import interruption
from dudmap.app.pipeline.background import Background
from dudmap.app.pipeline.frame_processing import process_source
from dudmap.app.pipeline.frame_source import AHEAD, SourceFrame, arriving, open_masks, read_ahead
from dudmap.app.pipeline.given_poses import POSES, checked_options, stored_poses
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.remarks import remarks
from dudmap.app.pipeline.run_folder import IGNORED, RunReport, locked, prepare_run_folder, save_mask, write_run_folder
from dudmap.app.pipeline.shedding import Shedding
from dudmap.app.pipeline.storing import RunOptions, RunState, RunStore, StoredRun, Storing
from dudmap.app.state.database import StateReader
from dudmap.app.state.tree import TreeReader
from dudmap.app.terminal import counted
from dudmap.config import Config
from dudmap.errors import CameraError, ConfigError, DatasetError, DeviceError, DudmapError
from dudmap.io.cameras import LiveCamera
from dudmap.io.cameras.recorder import Recorder
from dudmap.io.cameras.replay import ReplayCamera
from dudmap.io.sequences import has_color, is_timed
from dudmap.io.sequences.images import read_ignored
from dudmap.own_folder import check_outside

if TYPE_CHECKING:
    from dudmap.app.pipeline.given_poses import GivenPoses
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.core.slam import Slam
    from dudmap.io.sequences import Sequence
    from dudmap.io.sequences.masks import MaskFolder

log = logging.getLogger(__name__)

PREVIEW = 3


def run(
    sequence: "Sequence | LiveCamera",
    config: Config,
    out: str | Path,
    *,
    max_frames: int | None = None,
    save_masks: bool = False,
    save_map: bool = True,
    masks: str | Path | None = None,
    ignore: str | Path | None = None,
    progress: bool = True,
    ahead: int = AHEAD,
    live: bool = False,
    record: str | Path | None = None,
    passes: int = 1,
    poses: "GivenPoses | None" = None,
    calibration: "Calibration | None" = None,
    calibrate: bool = False,
    saved_map: "SavedMap | None" = None,
    localize: bool = False,
    max_memory: int | None = None,
    observers: "tuple[RunObserver, ...]" = (),
    storing: Storing | None = None,
    warnings: Iterable[str] = (),
) -> RunReport:
    """Run the system over a recording, or a camera until its end or Ctrl-C, and write a run folder (``docs/files.md``).

    Earlier results are removed first; an interrupted or failed run writes its results so far. With ``storing`` the
    folder holds state.db until the end, for ``dudmap.app.pipeline.resume.resume``.

    Args:
        sequence: Recording (its ground truth and masks are for evaluation only) or camera, closed at the end. Camera
            frames wait for at most 0.1 s; older ones are ``dropped``.
        config: All parameters.
        out: The run folder, created if needed.
        max_frames: Limit.
        save_masks: Write all dynamic masks.
        save_map: Write map.npz and keyframes.npz.
        masks: Folder of external masks (255 = dynamic), added to the estimated ones; named like the images or
            <timestamp>.png.
        ignore: Image, white at pixels that are never used; ignored.png is its copy.
        progress: Show a progress bar on a terminal.
        ahead: Frames read ahead, without effect on the result; 0 for rendered frames, which use all cores.
        live: Replay the recording as if it were a camera.
        record: MCAP file for all arriving frames.
        passes: 2 processes the recording twice, so that objects in view from the start also leave the map. The last
            complete pass is written.
        poses: Result, or start of registration; given_poses.txt is their copy. As result, frames without a pose are
            skipped.
        calibration: Of the colour camera; None takes the recording's or camera's.
        calibrate: Estimate it from the start of the recording first.
        saved_map: Map to continue, which is modified and gives the world frame.
        localize: Only find the camera in ``saved_map``, without map and mesh.
        max_memory: Resident memory, bytes; distant map parts wait on disk. None keeps all.
        observers: Of passes, frames, and the written folder.
        storing: Checkpoints; None for none; not with ``live``.
        warnings: Suspected faults of the recording (``pipeline.inspection``), for metrics.json.

    Raises:
        ConfigError: ``passes`` is not 1 or 2, or 2 with a camera or ``saved_map``; ``localize`` without ``saved_map``;
            ``storing`` with a camera; the system lacks an option.
        CameraError: The camera stopped delivering frames, after writing; or the recording cannot be written.
        DudmapError: The folder cannot be written, lies in the recording, or is in use. The recording cannot be used, or
            no frame was tracked.
        KeyboardInterrupt: Ctrl-C, after writing, unless it ends a camera's stream; it names the files.
    """
    from dudmap.app.pipeline.calibration import calibrate_start

    interruption.check()
    out = Path(out)
    if live and not isinstance(sequence, LiveCamera):
        sequence = ReplayCamera(sequence)
    check_outside(out, sequence)
    if record is not None:
        check_outside(Path(record), sequence, "--record")
    live = isinstance(sequence, LiveCamera)
    length = sequence.length if isinstance(sequence, LiveCamera) else len(sequence)
    count = length if max_frames is None else min(max_frames, length or max_frames)
    if count is not None and count < 1:
        raise DatasetError(f"{sequence.name} has {length} frames and {max_frames} are wanted; expected one or more")
    checked_options(has_poses=poses is not None, refine=False, saved_map=saved_map is not None)
    if passes not in (1, 2) or (live and passes == 2):
        raise ConfigError(
            f"found passes = {passes}{' of a live run' if live else ''}; expected 1, or 2 without live replay"
        )
    if saved_map is None and localize:
        raise ConfigError("there is nothing to localize in; name the run folder of a saved map (--map)")
    if max_memory is not None and passes == 2:
        raise ConfigError("found passes = 2 with a memory limit, but two passes need two maps; expected 1 pass")
    if saved_map is not None and passes == 2:
        raise ConfigError("found passes = 2 with a saved map, which is kept; expected 1 pass")
    if storing is not None and live:
        raise ConfigError("a live run cannot be stored, because its frames cannot be read again; drop live or storing")
    if record is not None and not live:
        raise ConfigError("only the frames of a camera are recorded; these are on the disk already")
    if config.system == "thesis":
        foreign = {"second pass": passes == 2, "saved map": saved_map, "memory limit": max_memory, "given masks": masks,
                   "checkpoints": storing, "mask of ignored pixels": ignore, "given poses": poses}  # fmt: skip
        if found := [name for name, given in foreign.items() if given]:
            raise ConfigError(f"the thesis' system has no {found[0]}; leave the option out or choose the system dudmap")
    ignored = None if ignore is None else read_ignored(ignore, sequence.camera, calibration or sequence.calibration)
    options = RunOptions(
        config=config, max_frames=count, save_masks=save_masks, save_map=save_map, masks=_resolved(masks), ahead=ahead,
        passes=passes, saved_map=_resolved(saved_map and saved_map.folder), localize=localize, max_memory=max_memory,
        storing=storing, poses=None if poses is None else poses.role,
        ignore=None if ignored is None else (out / IGNORED).resolve(),
    )  # fmt: skip
    figures = RunRecord(
        warnings=list(warnings), masked=None if masks is None else 0, dropped=0 if live else None,
        depth_limits=config.depth_limits,
    )  # fmt: skip
    with locked(out), ExitStack() as files:
        display = RunProgress(count and count * passes, bar=progress)
        prepare_run_folder(out, masks, save_masks=save_masks)
        if ignored is not None:
            save_mask(out / IGNORED, ignored)
        if poses is not None:
            poses.trajectory.save(out / POSES)
        recorder = store = None
        if record is not None:
            recorder = Recorder(Path(record), sequence.camera, sequence.calibration)
            files.callback(_finish_recording, recorder)
        if isinstance(sequence, LiveCamera):
            files.callback(sequence.close)
        folder = open_masks(masks, sequence)
        if folder is not None:
            log.log(logging.INFO if folder.complete else logging.WARNING, folder.said)
            figures.warnings += [] if folder.complete else [folder.said]
        job = Job(sequence, out, options, display, folder, observers, recorder)
        if storing is not None and not isinstance(sequence, LiveCamera):
            store = RunStore(out, storing.every, log.warning)
            store.order(sequence, options)
        display.announce_compilation()
        if calibrate and count is not None and not isinstance(sequence, LiveCamera):
            with counted("calibrating", quiet=not progress) as counting:
                try:
                    with interruption.recognised():
                        calibration = calibrate_start(sequence, config, count, counting, ignored)
                except KeyboardInterrupt:
                    resume = "" if store is None else f"; dudmap run --resume {out} begins again"
                    raise KeyboardInterrupt(f"interrupted while it calibrated{resume}") from None
        elif calibration is None and not live and has_color(sequence):
            log.info("colour: assumed as given, not tested")
        calibration = calibration or sequence.calibration
        slam = job.system(calibration=calibration, live=live, saved_map=saved_map, localize=localize)
        state = RunState(slam, figures, calibration)
        if store is not None:
            store.take(state, wait=True)
        return job.carry_out(state, store)


@dataclass(frozen=True, eq=False)
class Job:
    """A run with its options, see ``run``."""

    sequence: "Sequence | LiveCamera"
    out: Path
    options: RunOptions
    display: RunProgress
    masks: "MaskFolder | None" = None
    observers: "tuple[RunObserver, ...]" = ()
    recorder: Recorder | None = None

    @cached_property
    def poses(self) -> "GivenPoses | None":
        """Given poses, as stored in the run folder."""
        return None if self.options.poses is None else stored_poses(self.out, self.options.poses)

    def system(self, **given: Any) -> "Slam":  # noqa: ANN401 - arguments of Slam
        """Create a system for this recording."""
        if self.options.config.system == "thesis":
            from dudmap.thesis import ThesisSlam

            slam = ThesisSlam(self.sequence.camera, self.options.config.thesis, given["calibration"])
            return cast("Slam", slam)  # it has the attributes that a run without the options refused by ``run`` reads
        from dudmap.core.map.memory_limit import MemoryLimit
        from dudmap.core.slam import Slam

        limit = None if self.options.max_memory is None else MemoryLimit(self.options.max_memory)
        timed, path = is_timed(self.sequence), self.options.ignore
        calibration = given.get("calibration") or self.sequence.calibration
        ignored = None if path is None else read_ignored(path, self.sequence.camera, calibration)
        return Slam(
            self.sequence.camera,
            self.options.config,
            max_blocks=limit,
            timed=timed,
            ignore=ignored,
            poses=self.options.poses or "estimated",
            **given,
        )

    def restored(self, reader: StateReader, store: RunStore) -> RunState:
        """Restore the run's state at the checkpoint; ``store`` continues it."""
        with TreeReader(reader, store.database) as tree:
            return RunState.read(tree, StoredRun.model_validate(reader.meta()), self.options.config.device)

    def carry_out(self, state: RunState, store: RunStore | None = None) -> RunReport:
        """Process the remaining frames and write the locked run folder."""
        out, display, stopped, defect = self.out, self.display, "", False
        with ExitStack() as files, display:
            try:
                try:
                    with interruption.recognised():
                        self._process(state, store)
                except DeviceError as error:
                    if store is None:
                        raise
                    log.warning("%s; the run goes on on the CPU", error)
                    state, store = files.enter_context(self._from_checkpoint(state, store))
                    self._process(state, store)
                for remark in remarks(state.slam, state.record):
                    log.warning(remark)
            except KeyboardInterrupt:
                count, of_pass = len(state.record.rows), " of the second pass" if state.number else ""
                if not isinstance(self.sequence, LiveCamera):
                    stopped = f"interrupted after {count} frames{of_pass}"
                    resume = "" if store is None else f"; dudmap run --resume {out} goes on"
                    raise KeyboardInterrupt(f"{stopped}; {_saved(state)} in {out}{resume}") from None
                log.info("stopped by %s after %d frames", interruption.name(), count)  # like a stream that ends
            except DudmapError as error:
                stopped = str(error)
                raise type(error)(f"{stopped}; {_saved(state)} in {out}") from error
            except BaseException as error:
                stopped, defect = repr(error), not isinstance(error, OSError | MemoryError)
                raise
            finally:
                with interruption.postponed():
                    report = self._finish(state, store, stopped, defect=defect)
        record, count = state.record, self.options.max_frames or len(state.record.rows)
        if record.rows and not len(report.trajectory):
            raise DudmapError(f"none of the {count} frames could be tracked; the first: {record.lost[0]['reason']}")
        if not record.rows and isinstance(self.sequence, LiveCamera):
            raise CameraError(f"no frame of the camera {self.sequence.name} was processed")
        if not record.rows:
            raise DatasetError(f"none of the {count} frames could be read; the first: {record.unreadable[0]}")
        return report

    def _process(self, state: RunState, store: RunStore | None) -> None:
        options = self.options
        for number in range(state.number, options.passes):
            if number > state.number:
                state.first_record = state.record
                masked = state.record.masked and 0
                state.slam = self._next_system(state, first_pass=state.slam)
                spent, warnings = state.record.elapsed(), state.record.warnings
                limits = state.record.depth_limits
                state.record = RunRecord(warnings=warnings, masked=masked, spent=spent, depth_limits=limits)
                state.number, state.next = number, 0
            for observer in self.observers:
                if state.next:
                    observer.resume(state.slam, self.out, options.max_frames, state.next)
                else:
                    observer.start(state.slam, self.out, options.max_frames)
            mask_folder = self.out if options.save_masks and number == options.passes - 1 else None
            live = isinstance(self.sequence, LiveCamera)
            shedding = Shedding() if live and options.config.system != "thesis" else None
            with Background(postponed=live) as background, closing(self._frames(state, background)) as frames:
                for frame in frames:
                    with interruption.postponed():
                        process_source(
                            frame, state.slam, state.record, self.display, mask_folder, background, self.observers,
                            self.poses, shedding,
                        )  # fmt: skip
                        state.next = frame.number + 1
                        if store is not None:
                            store.frame(state, frame.read.frame, background)
                    interruption.check()
                    if len(state.record.rows) == options.max_frames:
                        break
        if store is not None:
            store.end(state)

    def _frames(self, state: RunState, background: Background) -> Generator[SourceFrame]:
        count, source, slam = self.options.max_frames, self.sequence, state.slam
        if isinstance(source, LiveCamera):
            self.display.working("loading kernels")
            first = self._next_system(state)
            for frame in source.preview(PREVIEW):
                first.process(frame)
            return arriving(source, slam, self.masks, self.recorder, background.next)
        assert count is not None
        return read_ahead(source, count, self.options.ahead, self.masks, slam, state.next)

    def _next_system(self, state: RunState, first_pass: "Slam | None" = None) -> "Slam":
        return self.system(first_pass=first_pass, calibration=state.calibration)

    @contextmanager
    def _from_checkpoint(self, state: RunState, store: RunStore) -> Iterator[tuple[RunState, RunStore]]:
        store.close(finished=False)
        with closing(StateReader(store.database.path)) as reader:
            store = store.reopened()
            old, state = state, self.restored(reader, store)
            log.info("frames %d to %d, after the last checkpoint, are processed again", state.next, old.next - 1)
            yield state, store

    def _finish(self, state: RunState, store: RunStore | None, stopped: str, *, defect: bool) -> RunReport:
        self.display.working("writing")
        slam, record = state.slam, state.record
        if stopped and state.number:  # the first pass is complete, the second is not
            slam, record = slam.first_pass or slam, state.first_record or record
        complete = False
        try:
            config, save_map = self.options.config, self.options.save_map
            report = write_run_folder(
                self.out, slam, record, self.sequence, config, stopped,
                save_map=save_map, defect=defect, poses=self.poses,
            )  # fmt: skip
            if said := (report.metrics.get("up") or {}).get("contradiction"):
                log.warning(said)
            for observer in self.observers:
                observer.finish(self.out)
            complete = not stopped
        finally:
            if store is not None:
                store.close(finished=complete)
        return report


def _saved(state: RunState) -> str:
    return f"the trajectory and the map {'of the first pass' if state.number else 'up to there'} are"


def _finish_recording(recorder: Recorder) -> None:
    with interruption.postponed():
        recorder.close()
    log.info("recorded %d frames to %s", recorder.written, recorder.path)
    if recorder.dropped:
        log.warning("%d frames are missing in the recording: the disk is too slow for the camera", recorder.dropped)


def _resolved(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path).resolve()
