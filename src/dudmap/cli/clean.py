"""``dudmap clean``: write a recording without its dynamic objects."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from dudmap.app.terminal import counted
from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.errors import DatasetError
from dudmap.own_folder import check_outside


def clean(
    reading: o.ReadingOptions,
    parameters: o.ParameterOptions,
    sequence: o.SequenceArgument,
    out: Annotated[
        Path, Argument(help="New folder for the recording without dynamic objects, in TUM layout.", metavar="OUT")
    ],
    run: Annotated[
        Path | None,
        Option(help="Run over this recording with --save-masks; default: one is made in OUT/run.", metavar="RUN"),
    ] = None,
    passes: o.PassesOption = 2,
    ignore: o.IgnoreOption = None,
    max_frames: o.MaxFramesOption = None,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Replace dynamic objects in every frame of a recording by the background from the map and from other frames."""
    from dataclasses import asdict

    from dudmap.app.pipeline.inspection import sample
    from dudmap.app.pipeline.run import run as run_sequence
    from dudmap.app.views.cleaning import clean_recording
    from dudmap.io.exporting.run_content import RunContent

    recording = reading.open(sequence)
    check_outside(out, recording, "OUT")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not an empty folder; name another one")
    if run is None:
        config = parameters.read(seen=[frame for _, frame in sample(recording)[0]])
        run_sequence(
            recording, config, out / "run",
            max_frames=max_frames, save_masks=True, passes=passes, ignore=ignore, calibrate=True,
            progress=not (quiet or as_json),
        )  # fmt: skip
    with counted("cleaning", quiet=quiet or as_json) as progress:
        report = clean_recording(RunContent.load(run or out / "run"), recording, out, progress, max_frames)
    text = (
        f"{report.frames} frames written to {out}: {report.replaced:.1%} of the pixels replaced, of which "
        f"{report.unknown / max(report.replaced, 1e-9):.1%} were never seen; {len(report.left_out)} frames without "
        "a pose left out"
    )
    answer(asdict(report), text, as_json=as_json, quiet=quiet)
