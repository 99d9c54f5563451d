"""``dudmap calibrate``: estimate pose, lens and timing of the colour camera relative to the depth camera."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from dudmap.cli import options as o
from dudmap.cli.output import answer
from dudmap.own_folder import check_outside

if TYPE_CHECKING:
    from rich.table import Table

    from dudmap.core.calibration.estimator import Estimate
    from dudmap.core.geometry.calibration import Calibration


def calibrate(
    reading: o.ReadingOptions,
    parameters: o.ParameterOptions,
    sequence: o.SequenceArgument,
    out: Annotated[Path | None, Option(help="Write the calibration to this TOML file.")] = None,
    calibration: Annotated[
        Path | None, Option(help="Calibration to start from: TOML file of an earlier one.", metavar="FILE")
    ] = None,
    ignore: o.IgnoreOption = None,
    max_frames: o.MaxFramesOption = None,
    as_json: o.JsonOption = False,
) -> None:
    """Estimate geometry, lens and timing of the colour camera relative to the depth camera.

    Tracks the recording, compares pairs of its images, and prints every parameter with its standard deviation.
    Parameters that the images do not prove keep the values of the files.
    """
    from dudmap.app.pipeline.calibration import calibrate_sequence, known_calibration
    from dudmap.app.pipeline.inspection import sample
    from dudmap.app.terminal import counted, plain_console
    from dudmap.core.geometry.calibration import Calibration
    from dudmap.io.sequences.images import read_ignored

    recording = reading.open(sequence)
    if out is not None:
        check_outside(out, recording)
    config = parameters.read(seen=[frame for _, frame in sample(recording)[0]])
    given = known_calibration(recording) if calibration is None else Calibration.load(calibration)
    ignored = None if ignore is None else read_ignored(ignore, recording.camera, given)
    with counted("calibrating", quiet=as_json) as progress:
        estimate = calibrate_sequence(recording, config, given, max_frames, progress=progress, ignore=ignored)
    if out is not None:
        replace(estimate.calibration, notes=tuple(remarks(estimate))).save(out)
    if as_json:
        evidence = {name: verdict.figure("evidence") for name, verdict in estimate.verdicts.items()}
        evidence = {name: value for name, value in evidence.items() if value == value}
        answer(estimate.calibration.tree() | {"evidence": evidence, "gain": estimate.gain}, "", as_json=True)
        return
    console = plain_console()
    console.print(table(given, estimate))
    for line in remarks(estimate):
        console.print(line, soft_wrap=True)
    if out is not None:
        console.print(f"written to {out}; use it with dudmap run {sequence} --calibration {out}", soft_wrap=True)


def table(given: "Calibration", estimate: "Estimate") -> "Table":
    """One row per parameter: change of the given value and standard deviation."""
    import numpy as np
    from rich.table import Table

    from dudmap.core.calibration.findings import UNITS, kind_of

    out = Table("parameter", "change", "sigma", "unit", "")
    found = estimate.calibration
    shutter = found.depth_readout - given.depth_readout
    change = [*given.step_to(found), found.vignetting - given.vignetting, shutter]
    for (name, sigma), value in zip(found.sigmas.items(), change, strict=True):
        unit, factor = UNITS[kind_of(name)]
        is_found = name in found.estimated
        out.add_row(
            name,
            f"{factor * value:+.3f}" if is_found else "",
            f"{factor * sigma:.3f}" if np.isfinite(sigma) else "",
            unit,
            "estimated" if is_found else "as given",
        )
    return out


def remarks(estimate: "Estimate") -> list[str]:
    """Sentences on the decisions and their reasons."""
    from dudmap.core.calibration.findings import findings

    return [
        *findings(estimate),
        f"{estimate.pairs} pairs of images; change of the cost of held-out images: {-100 * estimate.gain:+.1f} %",
        "the scale of the depth is not observable: it scales all motions and the offset alike",
    ]
