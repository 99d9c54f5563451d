"""Sentences at the end of a run on its findings."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from dudmap.app.pipeline.metrics import RunRecord
from dudmap.core.shed import Shed

if TYPE_CHECKING:
    from dudmap.core.slam import Slam


def remarks(slam: "Slam", record: RunRecord) -> Iterator[str]:
    """Sentences on skipped frames and separate maps."""
    if len(slam.maps) > 1:
        yield _unmerged_submaps(slam)
    if record.repeated:
        yield _repeats(record)
    if missing := record.rejected.get("pose", 0):
        yield f"{missing} frames are left out: no pose is given for them"
    if degenerate := record.counts["degenerate"]:
        yield f"{degenerate} frames do not show all directions of motion: not fused"
    if dropped := record.dropped:
        total = dropped + len(record.rows) + len(record.unreadable)
        yield f"live: {dropped} of {total} frames were dropped"
    if omitted := [row["shed"] for row in record.rows if row.get("shed")]:
        steps = {
            Shed.MOVERS: "have no moving objects", Shed.LABELS: "have the labels of the frame before",
            Shed.FUSION: "are not fused",
        }  # fmt: skip
        counts = {said: sum(step in Shed(shed) for shed in omitted) for step, said in steps.items()}
        said = ", ".join(f"{count} {said}" for said, count in counts.items() if count)
        yield f"live: for lack of time, of {len(record.rows)} frames {said}"


def _unmerged_submaps(slam: "Slam") -> str:
    main, *others = (len(trajectory) for trajectory, _ in slam.maps)
    names = " and ".join(f"mesh-{number}.ply ({count} frames)" for number, count in enumerate(others, start=2))
    return f"{len(others)} submap(s) could not be merged: the main map has {main} frames; the others are {names}"


def _repeats(record: RunRecord) -> str:
    what = {
        "frame": "{} both images (they have the pose of the frame before)",
        "depth": "{} the depth image (their poses are interpolated)",
        "color": "{} the colour image (tracked by distances alone, not fused)",
    }
    counts = ", ".join(text.format(record.repeated[kind]) for kind, text in what.items() if kind in record.repeated)
    return f"of {len(record.rows)} frames, some repeat images of the frame before: {counts}"
