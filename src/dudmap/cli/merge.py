"""``dudmap merge``: merge the maps of two or more runs of one place."""

import logging
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from dudmap.app.terminal import show_log
from dudmap.cli import options as o
from dudmap.cli.output import answer, free_folder

log = logging.getLogger(__name__)


def merge(
    runs: Annotated[list[Path], Argument(help="Run folders; the world frame of the first is kept.", metavar="RUN...")],
    out: Annotated[Path | None, Option(help="New folder; default: runs/<A>-<B>, or runs/world with more runs.")] = None,
    world: Annotated[bool, Option("--world", help="Write map parts and tiles also for two runs, as for more.")] = False,
    jobs: Annotated[int, Option(help="Processes, with more than two runs or --world.", metavar="N", min=1)] = 1,
    quiet: o.QuietOption = False,
    as_json: o.JsonOption = False,
) -> None:
    """Merge maps whose views overlap; refuse maps whose geometry or colours disagree.

    Two runs become a run folder: map.npz, keyframes.npz, mesh.ply, config.toml, merge.json and the trajectories of both
    in the world frame of the first. More runs become a world: map/ (parts of the map), tileset.json and tiles/ (3D
    Tiles), world.json and the trajectories.
    """
    if len(runs) == 2 and not world:
        from dudmap.fleet.merge import merge_runs

        folder = out or free_folder(Path("runs") / f"{runs[0].name}-{runs[1].name}")
        found = merge_runs(runs[0], runs[1], folder)
        text = (
            f"merged by {found['features']} features of {found['keyframes']} keyframes: {found['area']:.1f} m2 of "
            f"common surface, {found['denied']:.1%} denied by free space, colour correlation "
            f"{found['color_correlation']:.2f}\nwritten to {folder}"
        )
        if found["finer_blocks_left_out"]:
            text += f"; {found['finer_blocks_left_out']} blocks with smaller voxels are left out"
    else:
        from dudmap.fleet.merge import merge_fleet

        show_log(quiet=quiet)
        fleet = merge_fleet(runs, out or free_folder(Path("runs") / "world"), workers=jobs)
        found = fleet.tree
        for sentence in fleet.sentences:
            log.warning(sentence)
        text = (
            f"{len(found['runs'])} of {len(runs)} runs joined: {found['map_blocks']} blocks in {len(found['ranges'])} "
            f"parts, {found['tiles']} tiles\nwritten to {fleet.out}"
        )
    answer(found, text, as_json=as_json, quiet=quiet)
