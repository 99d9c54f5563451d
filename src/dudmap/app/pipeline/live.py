"""A live run: frames of a camera are processed as they arrive; those dropped are counted, all may be recorded."""

from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dudmap.app.pipeline.frame_source import SourceFrame, prepared
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.replay import arrivals
from dudmap.app.pipeline.run import Job
from dudmap.app.pipeline.run_folder import RunReport, locked, prepare_run_folder
from dudmap.app.pipeline.storing import RunOptions, RunState
from dudmap.config import Config
from dudmap.errors import FrameError
from dudmap.io.cameras import LiveCamera
from dudmap.io.cameras.recorder import Recorder

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.core.geometry.calibration import Calibration

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
    out, calibration = Path(out), calibration or camera.calibration
    options = RunOptions(config=config, max_frames=max_frames, save_masks=save_masks, save_map=save_map, live=True)
    with locked(out):
        prepare_run_folder(out, None, save_masks=save_masks)
        recorder = None if record is None else Recorder(Path(record), camera.camera, camera.calibration)
        display = RunProgress(max_frames or camera.length, bar=progress)
        arriving = partial(_arriving_frames, camera, recorder)
        job = Job(camera, out, options, display, observers=observers, arriving=arriving)
        try:
            system = job.system(calibration=calibration)
            return job.carry_out(RunState(system, RunRecord(dropped=0), calibration))
        finally:
            camera.close()
            _finish(recorder, display)


def _arriving_frames(
    camera: LiveCamera, recorder: Recorder | None, job: Job, state: RunState
) -> Generator[SourceFrame]:
    """Frames of the camera after the kernels are loaded, prepared by the thread that takes them; all that arrive are
    recorded, those for which there is no time are dropped."""

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
            put(SourceFrame(arrived.number - start, prepared(arrived.frame, state.slam), arrival=arrived.time))

    job.display.working("loading kernels")
    job.display.announce_compilation()
    first = job.system(calibration=state.calibration)
    for frame in camera.preview(PREVIEW):
        first.process(frame)
    yield from arrivals(deliver, camera.close, state.record.catch_up)


def _finish(recorder: Recorder | None, display: RunProgress) -> None:
    """Complete the recording and say what is in it."""
    if recorder is None:
        return
    recorder.close()
    display.note(f"recorded {recorder.written} frames to {recorder.path}")
    if recorder.dropped:
        display.note(f"{recorder.dropped} frames are missing in the recording: the disk is too slow for the camera")
