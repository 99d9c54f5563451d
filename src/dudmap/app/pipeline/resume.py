"""Continuation of an interrupted run from the state in its folder."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dudmap.app.pipeline.progress import RunProgress
from dudmap.app.pipeline.run import Job, run
from dudmap.app.pipeline.run_folder import RunReport, locked
from dudmap.app.pipeline.storing import RunStore, Storing, check_recording, restored, stored_options
from dudmap.app.state.system import on_device
from dudmap.config import Config
from dudmap.errors import StateError
from dudmap.input_files import damaged
from dudmap.io.sequences import is_timed

if TYPE_CHECKING:
    from dudmap.app.pipeline.observer import RunObserver
    from dudmap.io.sequences import Sequence
    from dudmap.io.sequences.masks import MaskFolder


def resume(
    out: str | Path,
    sequence: "Sequence | None" = None,
    *,
    device: str | None = None,
    progress: bool = True,
    observers: "tuple[RunObserver, ...]" = (),
) -> RunReport:
    """Go on with a run that was killed or interrupted, from its last checkpoint to the end.

    One that ended while it calibrated the colour camera begins anew. Recording, configuration and options are those the
    run began with. Results are those of a run that was not interrupted: the same poses, masks, map and mesh, bit for
    bit.

    Args:
        out: The run folder.
        sequence: The recording; None opens the one that the run began with.
        device: Device to go on on, if it is to be another one: results then differ by roundings.
        progress: Show a progress bar on a terminal.
        observers: As for ``run``.

    Raises:
        StateError: There is no state in the folder, the run is finished, its recording has changed, another version of
            dudmap wrote it, or it is damaged.
        DudmapError: As for ``run``; or the run is still alive, or another one writes into the folder.
    """
    from dudmap.core.map.memory_limit import MemoryLimit
    from dudmap.core.places.saved_map import SavedMap
    from dudmap.core.slam import Slam

    out = Path(out)
    if not out.is_dir():
        raise StateError(f"there is no run folder {out}")
    with locked(out):
        reader, meta = stored_options(out)
        with closing(reader):
            options = meta["options"]
            with damaged(StateError, reader.path):
                sequence = open_recording(options["recording"]) if sequence is None else sequence
                config = on_device(Config.model_validate_json(options["config"]), device)
            check_recording(sequence, meta, out)
            limit = None if options["max_memory"] is None else MemoryLimit(options["max_memory"])
            if "pass" in meta:
                display = RunProgress(options["count"] * options["passes"], bar=progress)
                try:
                    store = RunStore(out, options["every"], display.note)
                    systems = (
                        Slam(sequence.camera, config, max_blocks=limit, timed=is_timed(sequence)) for _ in range(2)
                    )
                    state = restored(reader, store, *systems)
                except sqlite3.Error as error:
                    raise StateError(f"the state of the run in {out} cannot be read: {error}") from error
                job = Job(
                    sequence, config, out, options["count"], display, _masks(options["masks"], sequence),
                    options["save_masks"], options["save_map"], options["ahead"], False, options["passes"], None,
                    observers,
                )  # fmt: skip
                return job.carry_out(state, store)
    saved = options["saved_map"]
    return run(
        sequence, config, out,
        max_frames=options["count"], save_masks=options["save_masks"], save_map=options["save_map"],
        masks=options["masks"], progress=progress, ahead=options["ahead"], passes=options["passes"],
        depth_model=options["depth_model"], calibrate=True, localize=options["localize"],
        saved_map=None if saved is None else SavedMap.load(saved, config.volume.voxel_size),
        max_memory=options["max_memory"], observers=observers,
        storing=Storing(options["recording"], options["every"], options["report"]),
    )  # fmt: skip


def open_recording(arguments: dict[str, Any]) -> "Sequence":
    """The recording that a stored run is of."""
    from dudmap.io.sequences import open_sequence

    return open_sequence(**arguments)


def wants_report(out: Path) -> bool:
    """Whether the run in a folder was ordered with a report.

    Raises:
        StateError: The folder holds no run that can be continued.
    """
    reader, meta = stored_options(out)
    reader.close()
    return bool(meta["options"]["report"])


def _masks(folder: str | None, sequence: "Sequence") -> "MaskFolder | None":
    from dudmap.io.sequences.masks import MaskFolder

    return None if folder is None else MaskFolder(folder, sequence.timestamps, sequence.camera)
