"""One frame of a run: processed, counted, reported."""

import logging
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.app.pipeline.background import Background
from dudmap.app.pipeline.frame_source import SourceFrame
from dudmap.app.pipeline.metrics import RunRecord
from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.run_folder import save_mask
from dudmap.app.pipeline.shedding import SAID, Shedding
from dudmap.core.calibration.findings import outcome
from dudmap.errors import FrameError

if TYPE_CHECKING:
    from dudmap.app.pipeline.given_poses import GivenPoses
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.core.slam import Slam

log = logging.getLogger(__name__)

MAKE_ROOM = "make room on the disk of the run folder"


def process_source(
    source: SourceFrame,
    slam: "Slam",
    record: RunRecord,
    display: RunProgress,
    mask_folder: Path | None,
    background: Background,
    observers: "tuple[RunObserver, ...]" = (),
    poses: "GivenPoses | None" = None,
    shedding: Shedding | None = None,
) -> None:
    """Process one frame, count it, save its mask, and report it; files and moving objects are done in the background.
    ``shedding`` chooses the work that a live run omits."""
    index, read = source.number, source.read
    if record.dropped is not None:
        record.dropped += source.dropped
    if isinstance(read.frame, FrameError):
        record.skip(read.frame)
        display.skip(read.frame)
        for observer in observers:
            observer.event("unreadable", frame=index, reason=str(read.frame))
        return
    true_mask, given_mask = read.true_mask, read.given_mask
    if isinstance(true_mask, FrameError):
        log.warning("frame %d: the true mask is not scored, %s", index, true_mask)
        true_mask = None
    if isinstance(given_mask, FrameError):
        log.warning("frame %d: the given mask is ignored, %s", index, given_mask)
        given_mask = None
    start = time.perf_counter()
    frame = read.prepared or read.frame
    if shedding is not None:
        slam.shed = shedding.omitted
    try:
        given: dict[str, Any] = {} if given_mask is None else {"dynamic_mask": given_mask}
        if poses is not None:
            given["T_world_camera"] = poses.at(read.frame.timestamp)
        result = slam.process(frame, **given)
    except FrameError as error:
        record.skip(error)
        display.skip(error)
        return
    end = time.perf_counter()
    if record.masked is not None:
        record.masked += given_mask is not None
    delays = {}
    if record.dropped is not None:
        delays = {"dropped": source.dropped, "latency": 1000 * (end - source.arrival), "shed": int(result.shed)}
    record.add_readings(read.frame)
    record.add(result, 1000 * (end - start), read.ms, true_mask, **delays)
    row = record.rows[-1]
    read = read._replace(prepared=None)  # background jobs hold no pyramids

    def notify(*, in_background: bool) -> None:
        for observer in observers:
            if observer.in_background == in_background:
                try:
                    observer.frame(index, read, result, row["total"])
                except OSError as error:
                    display.once(f"images for the report cannot be written: {error}; {MAKE_ROOM}")

    def keep_images() -> None:
        if mask_folder is not None and result.status != "rejected":
            try:
                save_mask(mask_folder / "masks" / f"{result.timestamp:.6f}.png", result.dynamic_mask)
            except OSError as error:
                display.once(f"masks cannot be written: {error}; {MAKE_ROOM}")
        if not result.shed:
            notify(in_background=True)

    if record.dropped is None:
        record.add_movers(row, result)
        background.do(keep_images)
    else:  # postponed jobs hold no images
        keep_images()
        background.do(partial(record.add_movers, row, result))
    notify(in_background=False)
    if "calibrated" in result.events:
        log.info("frame %d: %s", index, outcome(slam.calibration, slam.camera))
    if shedding is not None:
        shedding.add(index, source.arrival, time.perf_counter() - start)
    display.frame(index, result, record.dropped, "" if shedding is None else SAID[shedding.omitted])
