"""Continue an interrupted run from its folder."""

import logging
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from dudmap.app.pipeline.frame_source import open_masks
from dudmap.app.pipeline.given_poses import stored_poses
from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.run import Job, run
from dudmap.app.pipeline.run_folder import RunReport, locked
from dudmap.app.pipeline.storing import RunStore, check_recording, stored_options
from dudmap.app.state.system import on_device
from dudmap.errors import StateError
from dudmap.input_files import damaged

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.io.sequences import Sequence

log = logging.getLogger(__name__)


def resume(
    out: str | Path,
    sequence: "Sequence | None" = None,
    *,
    device: str | None = None,
    progress: bool = True,
    observers: "tuple[RunObserver, ...]" = (),
) -> RunReport:
    """Continue an interrupted run from its last checkpoint, bit-identically, with its recording, configuration and
    options.

    Args:
        sequence: The recording; None opens the recording of the run.
        device: Other device; results differ by rounding.

    Raises:
        StateError: No state, a finished run, a changed recording, or a damaged or foreign state.
        DudmapError: As for ``run``; or another process writes into the folder.
    """
    from dudmap.app.viewing.report import ReportObserver
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.io.sequences import open_sequence

    out = Path(out)
    if not out.is_dir():
        raise StateError(f"there is no run folder {out}")
    with locked(out):
        reader, stored = stored_options(out)
        with closing(reader):
            options, storing = stored.options, stored.options.storing
            with damaged(StateError, reader.path):
                count = options.max_frames
                if storing is None or count is None:
                    raise ValueError("it does not say of which recording it is")
                sequence = open_sequence(**storing.recording) if sequence is None else sequence
                options = options.model_copy(update={"config": on_device(options.config, device)})
            check_recording(sequence, stored, out)
            if storing.report:
                observers = (*observers, ReportObserver())
            if stored.number is not None:
                display = RunProgress(count * options.passes, bar=progress)
                masks = open_masks(options.masks, sequence)
                job = Job(sequence, out, options, display, masks, observers)
                try:
                    store = RunStore(out, storing.every, log.warning)
                    state = job.restored(reader, store)
                except sqlite3.Error as error:
                    raise StateError(f"the state of the run in {out} cannot be read: {error}") from error
                return job.carry_out(state, store)
    config, folder = options.config, options.saved_map
    saved_map = None if folder is None else SavedMap.load(folder, config.volume.voxel_size)
    others = {name: value for name, value in options if name not in ("config", "saved_map", "poses")}
    poses = None if options.poses is None else stored_poses(out, options.poses)
    return run(
        sequence,
        config,
        out,
        saved_map=saved_map,
        poses=poses,
        calibrate=True,
        progress=progress,
        observers=observers,
        **others,
    )
