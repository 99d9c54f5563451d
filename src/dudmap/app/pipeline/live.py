"""A live run: frames of a camera are processed as they arrive; those dropped are counted, all may be recorded."""

from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dudmap.app.pipeline.frame_source import SourceFrame, prepared
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.replay import arrivals
from dudmap.app.pipeline.run import process_source
from dudmap.app.pipeline.run_folder import RunReport, locked, prepare_run_folder, write_run_folder
from dudmap.config import Config
from dudmap.errors import CameraError, DudmapError, FrameError
from dudmap.io.cameras import LiveCamera
from dudmap.io.cameras.recorder import Recorder

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.core.slam import Slam

PREVIEW = 3
"""Frames with which the kernels are compiled or loaded before the stream begins."""


def run_live(
    camera: LiveCamera,
    config: Config,
    out: str | Path,
    *,
    max_frames: int | None = None,
    save_masks: bool = False,
    save_map: bool = True,
    record: str | Path | None = None,
    calibration: "Calibration | None" = None,
    progress: bool = True,
    observers: "tuple[RunObserver, ...]" = (),
) -> RunReport:
    """Run the system on a camera until the stream ends, ``max_frames`` are processed, or Ctrl-C; write a run folder.

    Of the frames that arrive while one is processed, those of the last 0.1 s wait; older ones are counted as
    ``dropped`` in metrics.json and timings.csv. The folder is that of ``dudmap.run``. The camera is closed at the end.

    Args:
        camera: The opened camera.
        config: All parameters.
        out: The run folder; created if needed.
        max_frames: Process only this many frames.
        save_masks: Write the dynamic mask of every processed frame.
        save_map: Write map.npz.
        record: MCAP file for all frames that arrive, processed or not.
        calibration: Of the colour camera; None takes that of the camera.
        progress: Show a progress bar on a terminal.

    Raises:
        CameraError: The camera stopped to deliver frames, after writing; or the recording cannot be written.
        DudmapError: Another process writes into the folder, it cannot be written, or no frame could be tracked.
    """
    from dudmap.core.slam import Slam

    out, calibration = Path(out), calibration or camera.calibration
    metrics = RunRecord(dropped=0)
    slam = Slam(camera.camera, config, calibration=calibration, timed=camera.timed)
    stopped, defect = "", False
    with locked(out), RunProgress(max_frames or camera.length, bar=progress) as display:
        prepare_run_folder(out, None, save_masks=save_masks)
        recorder = None if record is None else Recorder(Path(record), camera.camera, camera.calibration)
        try:
            display.working("loading kernels")
            first = Slam(camera.camera, config, calibration=calibration, timed=camera.timed)
            for frame in camera.preview(PREVIEW):
                first.process(frame)
            for observer in observers:
                observer.start(slam, out, None)
            with closing(_arriving_frames(camera, recorder, slam, metrics.catch_up)) as frames:
                for source in frames:
                    process_source(source, slam, metrics, display, out if save_masks else None, None, observers)
                    if max_frames is not None and len(metrics.rows) >= max_frames:
                        break
        except KeyboardInterrupt:
            display.note(f"stopped by Ctrl-C after {len(metrics.rows)} frames")
        except DudmapError as error:
            stopped = str(error)
            raise type(error)(f"{stopped}; the trajectory and the map up to there are in {out}") from error
        except BaseException as error:
            stopped, defect = repr(error), not isinstance(error, OSError)
            raise
        finally:
            try:
                camera.close()
                display.working("writing")
                report = write_run_folder(out, slam, metrics, camera, config, stopped, save_map=save_map, defect=defect)
                for observer in observers:
                    observer.finish(out)
            finally:
                _finish(recorder, display)
    if metrics.dropped:
        display.note(f"live: {metrics.dropped} of {metrics.dropped + len(metrics.rows)} frames were dropped")
    if not metrics.rows:
        raise CameraError(f"no frame of the camera {camera.name} was processed")
    if not len(report.trajectory):
        raise DudmapError(f"none of the frames could be tracked; the first: {metrics.lost[0]['reason']}")
    return report


def _arriving_frames(
    camera: LiveCamera, recorder: Recorder | None, slam: "Slam", idle: Callable[[], bool]
) -> Generator[SourceFrame]:
    """Frames of the camera, prepared by the thread that takes them; all that arrive are recorded, those for which there
    is no time are dropped. For ``idle`` see ``replay.arrivals``."""

    def deliver(put: Callable[[SourceFrame], None], wait: Callable[[float], bool]) -> None:
        start, latest = None, -np.inf
        while not wait(0) and (arrived := camera.read()) is not None:
            start = arrived.number if start is None else start
            if not isinstance(arrived.frame, FrameError):
                if arrived.frame.timestamp <= latest:  # a driver may deliver a depth image twice
                    continue
                latest = arrived.frame.timestamp
                if recorder is not None:
                    recorder.put(arrived.frame)
            put(SourceFrame(arrived.number - start, prepared(arrived.frame, slam), arrival=arrived.time))

    return arrivals(deliver, camera.close, idle)


def _finish(recorder: Recorder | None, display: RunProgress) -> None:
    """Complete the recording and say what is in it."""
    if recorder is None:
        return
    recorder.close()
    display.note(f"recorded {recorder.written} frames to {recorder.path}")
    if recorder.dropped:
        display.note(f"{recorder.dropped} frames are missing in the recording: the disk is too slow for the camera")
