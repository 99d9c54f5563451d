"""``dudmap synth``: render a synthetic recording with exact ground truth."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from dudmap.app.terminal import counted
from dudmap.cli import options as o
from dudmap.cli.output import answer


def synth(
    out: Annotated[Path, Argument(help="Output folder, in TUM layout with ground truth.")],
    scene: Annotated[str, Option(help="room, corridor, desk, yard, textureless, plane or box.")] = "room",
    camera_path: Annotated[
        str | None,
        Option(
            help="handheld, slow, fast, still, pan, orbit, dolly, follow, or a trajectory file (TUM or EuRoC).",
            metavar="FILE|NAME",
        ),
    ] = None,
    movers: Annotated[
        list[str] | None,
        Option(
            help="person, people, wanderer, carried_box, removed_box, ball, balloon, creeper, stopping_cart, "
            "starting_cart, door; comma-separated or repeated; none for a static scene."
        ),
    ] = None,
    speed: Annotated[float | None, Option(help="Speed of the movers.", metavar="M_PER_S")] = None,
    coverage: Annotated[
        float | None, Option(help="Share of the image covered by a stream of people, 0 to 0.95.", metavar="SHARE")
    ] = None,
    start_dynamic: Annotated[bool, Option("--start-dynamic", help="Movers are in view in the first frame.")] = False,
    situation: Annotated[
        str | None, Option(help="people_at_start, follow, blocked, kidnapped, stops, starts, put_down or taken_away.")
    ] = None,
    max_frames: o.FramesOption = 120,
    fps: o.RateOption = 30.0,
    sensor: Annotated[
        str | None,
        Option(
            help="A camera with its noise, faults and view: kinect_v1, kinect_v2, realsense_d435, realsense_l515 or "
            "iphone_lidar."
        ),
    ] = None,
    noise: Annotated[
        str | None,
        Option(
            help="Noise of depth and colour: kinect (default without --sensor), realsense, d435, kinect_v2, l515, "
            "iphone, or none."
        ),
    ] = None,
    seed: o.SeedOption = 0,
    size: o.SizeOption = "640x480",
    motion_blur: Annotated[
        float | None, Option(help="Exposure time as a share of the frame interval, by default 0.")
    ] = None,
    exposure_change: Annotated[float, Option(help="Relative amplitude of a slow oscillation of the exposure.")] = 0.0,
    fault: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=VALUE",
            help="A fault of the sensor, on top of --sensor, such as color_delay=0.025; repeatable. "
            "The names are in docs/synthetic.md; an unknown one lists them.",
        ),
    ] = None,
    visits: Annotated[
        int, Option(min=1, max=2, help="2: two recordings of one place, with --changes between them.")
    ] = 1,
    changes: Annotated[
        str,
        Option(
            metavar="THING:KIND,...",
            help="box, ball, bin, chair or shelf :moved, :appeared or :disappeared, door:opened, poster:recoloured; or "
            "none. With --movers people, these people walk through the second visit.",
        ),
    ] = "none",
    overwrite: Annotated[bool, Option("--overwrite", help="Write into a folder that is not empty.")] = False,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Render a synthetic recording with exact ground truth.

    Writes rgb/, depth/, masks/ and their lists, groundtruth.txt, intrinsics.txt, movers.jsonl, surface.ply,
    surface_observed.ply, scene.json and sensor_truth.json. With --visits 2 these are in visit-1 and visit-2, and
    changes.json lists the changes and their visible surface in each visit.
    """
    from dudmap.lab import synthetic
    from dudmap.lab.synthetic.faults import parse_faults
    from dudmap.lab.synthetic.folder import write_folder

    options: dict[str, Any] = {"frames": max_frames, "fps": fps, "noise": noise, "camera": o.image_size(size)}
    if visits == 2 or changes != "none":
        from dudmap.lab.synthetic.visits import parsed_changes, write_visits
        from dudmap.lab.synthetic.visits import visits as two_visits

        if visits != 2:
            raise typer.BadParameter("--changes lie between two visits; add --visits 2")
        people, path = "people" in (_names(movers) or []), camera_path or "pan"
        recordings, truth = two_visits(
            parsed_changes(changes), scene=scene, seed=seed, people=people, paths=(path, path), sensor=sensor, **options
        )
        write_visits(recordings, truth, out, overwrite=overwrite)
        kinds = [f"{change.thing} {change.kind}" for change in truth]
        tree: dict[str, Any] = {"out": out, "frames": max_frames, "changes": kinds}
        answer(tree, f"{out}: two visits, {', '.join(kinds) or 'nothing changed'}", as_json=as_json, quiet=quiet)
        return
    sequence = synthetic.sequence(
        scene, _names(movers), camera_path, speed=speed, coverage=coverage, start_dynamic=start_dynamic,
        situation=situation, seed=seed, motion_blur=motion_blur, exposure_change=exposure_change, sensor=sensor,
        faults=parse_faults(fault or []), **options,
    )  # fmt: skip
    start, count = time.perf_counter(), len(sequence)
    with counted("rendering", quiet=quiet or as_json) as progress:
        write_folder(sequence, out, overwrite=overwrite, progress=lambda done: progress(done, count))
    seconds = time.perf_counter() - start
    tree = {"out": out, "frames": count, "sequence": sequence.name, "seconds": round(seconds, 3)}
    answer(tree, f"{out}: {count} frames of {sequence.name} in {seconds:.1f} s", as_json=as_json, quiet=quiet)


def _names(movers: list[str] | None) -> list[str] | None:
    if movers is None:
        return None
    found = [name.strip() for text in movers for name in text.split(",") if name.strip()]
    return [] if found == ["none"] else found
