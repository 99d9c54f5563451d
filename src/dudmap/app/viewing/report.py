"""Report of a run: one offline HTML page, and thumbnails."""

import base64
import gzip
import hashlib
import json
import re
import string
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dudmap.app.pipeline.observer import RunObserver
from dudmap.app.pipeline.run_folder import WRITTEN
from dudmap.app.viewing.metrics_table import metrics_table
from dudmap.app.viewing.plots import plots
from dudmap.app.viewing.run_files import FOLDER, RunFiles
from dudmap.app.viewing.snapshot import FrameImages
from dudmap.atomic_file import write_bytes, write_text, writing
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.errors import DudmapError, FrameError, printable
from dudmap.input_files import damaged
from dudmap.own_folder import OwnFolder, make_folder, remove_files
from dudmap.version import __version__

if TYPE_CHECKING:
    from dudmap.app.pipeline.frame_source import FrameRead
    from dudmap.core.result import FrameResult
    from dudmap.core.slam import Slam

NUMBER = 36
"""Kept frames: about 1.5 MB."""

STEPS = 65535
"""Steps of a coordinate over the mesh: 0.15 mm in a map of 10 m."""
REPORT = "report.html"
TRIANGLES = 200_000
"""Triangles in the page: about 1.5 MB."""
POSES = 5000
"""Poses in the page, thinned evenly."""
POLICY = "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'"
"""Content security policy: the page's own content only."""
NOT_INCLUDED = "preprocess", "movers"
"""Stages outside the time to the result."""
COLORS = "#2f6fb5", "#d98a00", "#2e8b57", "#c8322d", "#7b4fa3", "#14949b", "#8c564b", "#d65fa5", "#9aa7b6"
LISTED = 200
"""Lost or unreadable frames listed one by one."""
CARDS = {
    "frames": ("frames", 1, "{:.0f}"),
    "lost": ("lost", 1, "{:.0f}"),
    "ms_per_frame_median": ("median per frame", 1, "{:.0f} ms"),
    "dynamic_share_mean": ("of the readings move", 100, "{:.1f} %"),
    "mesh_triangles": ("triangles", 1e-3, "{:.0f} k"),
    "ate_rmse_m": ("ATE RMSE", 1000, "{:.1f} mm"),
    "mask_iou_mean": ("mask IoU", 1, "{:.3f}"),
}
"""Label, factor and format of the metrics at the top, by key."""


class Thumbnails(RunObserver):
    """Writes ``thumbnails/<timestamp>.<kind>.jpg`` for up to ``NUMBER`` even frames, of a camera up to ``2 NUMBER``."""

    in_background = True

    def __init__(self) -> None:
        self._out, self._count, self._next, self._step = Path(), None, 0, 1
        self._kept: list[list[Path]] = []

    def start(self, slam: "Slam", out: Path, count: int | None) -> None:
        """Prepare the folder for a pass of ``count`` frames."""
        self._out, self._count, self._next, self._step, self._kept = out / FOLDER, count, 0, 1, []
        make_folder(self._out)
        remove_files(out, {FOLDER: WRITTEN[FOLDER]})  # of the first pass; timestamps of a live run may differ

    def resume(self, slam: "Slam", out: Path, count: int | None, first: int) -> None:
        """Keep the images of frames before ``first``."""
        self._out, self._count, self._step, self._kept = out / FOLDER, count, 1, []
        make_folder(self._out)
        self._next = self._next_after(first - 1)

    def frame(self, index: int, read: "FrameRead", result: "FrameResult", ms: float) -> None:
        """Write the images of the first frame in each of the equal parts."""
        if index < self._next or isinstance(read.frame, FrameError):
            return
        paths = []
        for kind, file in FrameImages.of(read.frame, result).files().items():
            paths.append(self._out / f"{result.timestamp:.6f}.{kind}.jpg")
            write_bytes(paths[-1], file, sync=False, own=True)
        self._kept.append(paths)
        if self._count is None:
            self._thin()
            self._next = index + self._step
        else:
            self._next = self._next_after(index)

    def _next_after(self, index: int) -> int:
        assert self._count is not None
        return -(-(index * NUMBER // self._count + 1) * self._count // NUMBER)

    def _thin(self) -> None:
        if len(self._kept) <= 2 * NUMBER:
            return
        with OwnFolder(self._out) as folder:
            for path in (path for paths in self._kept[1::2] for path in paths):
                folder.remove(path.name)
        self._kept, self._step = self._kept[::2], 2 * self._step


class Html(str):
    """Trusted HTML of ``html``, ``joined`` or dudmap; other text is escaped."""

    __slots__ = ()


class _Escaping(string.Formatter):
    def format_field(self, value: object, format_spec: str) -> str:
        return value if isinstance(value, Html) else escape(format(value, format_spec))


def html(template: str, /, **values: object) -> Html:
    """HTML of a template in the syntax of ``str.format``, whose values are escaped."""
    return Html(_Escaping().vformat(template, (), values))


def joined(parts: Iterable[object], between: str = "") -> Html:
    """Concatenate parts, escaping others than ``Html``."""
    return Html(between.join(html("{part}", part=part) for part in parts))


def script_source(script: str) -> str:
    """Source in a content security policy for this script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def packed(mesh: Mesh) -> tuple[dict[str, Any], str]:
    """Description of a mesh, and its data as base64 of gzip.

    Little-endian: positions, uint16 (V, 3), from ``low`` (0) to ``high`` (65535) of the box; colours, uint8 (V, 3);
    zeros up to a multiple of 4 bytes; faces, int32 (F, 3), as differences to the previous index.
    """
    low, high = mesh.vertices.min(axis=0).astype(float), mesh.vertices.max(axis=0).astype(float)
    positions = np.rint((mesh.vertices - low) / np.maximum(high - low, 1e-9) * STEPS).astype("<u2")
    steps = np.diff(mesh.faces.reshape(-1), prepend=0).astype("<i4")
    head = positions.tobytes() + mesh.colors.tobytes()
    data = gzip.compress(head + bytes(-len(head) % 4) + steps.tobytes(), compresslevel=6, mtime=0)
    about = {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "low": low.round(6).tolist(),
        "high": high.round(6).tolist(),
    }
    return about, base64.b64encode(data).decode("ascii")


def write_report(folder: str | Path, out: str | Path | None = None) -> Path:
    """Write the report of a run folder, by default report.html in it; return its path.

    The page shows the mesh (at most ``TRIANGLES`` triangles) with trajectory and moving objects in 3D, thumbnails,
    plots, metrics, configuration, and lost frames with reasons.

    Raises:
        DudmapError: No complete run folder, a newer version, or the page cannot be written.
    """
    path = Path(out) if out is not None else Path(folder) / REPORT
    run = RunFiles.load(folder)
    with damaged(DudmapError, f"the run folder {folder}"):
        page = report_page(run)
    with writing(f"the report {path}"):
        write_text(path, page)
    return path


def report_page(run: RunFiles) -> str:
    """HTML text of the report."""
    found = run.mesh
    about, mesh = (None, "") if found is None or len(found.faces) == 0 else packed(simplified(found, TRIANGLES))
    parts = {
        "title": printable(run.metrics.get("sequence") or run.folder.name),
        "verdict": _verdict(run.metrics),
        "cards": _cards(run.metrics),
        "strips": _strip(run),
        "losses": _losses(run.metrics),
        "plots": joined(
            html("<figure>{svg}<figcaption>{title}</figcaption></figure>", svg=Html(svg), title=title)
            for title, svg in plots(run).items()
        ),
        "stages": _stages(run),
        "table": _table(run.metrics),
        "config": run.config or "The run folder has no config.toml.",
        "mesh": mesh,
    }
    return filled("report", scene_data(run) | {"mesh": about}, parts)


def filled(name: str, data: dict[str, Any], parts: dict[str, Any]) -> str:
    """HTML of a page, filled with parts, style, scripts and data."""
    library = f"\n/* three.js\n{asset('three.LICENSE.txt')}*/\n{asset('three.min.js')}"
    script = Html(asset("scene.js") + asset(f"{name}.js"))
    parts = parts | {
        "policy": POLICY.format(scripts=" ".join(script_source(text) for text in (library, script))),
        "version": __version__, "css": asset("report.css"), "library": Html(library), "script": script,
        "data": Html(json.dumps(data, allow_nan=False).replace("<", "\\u003c")),
    }  # fmt: skip
    return re.sub(r"\{\{(\w+)\}\}", lambda match: html("{part}", part=parts[match[1]]), asset(f"{name}.html"))


def scene_data(run: RunFiles) -> dict[str, Any]:
    """Camera, and per pose time, position with quaternion (x y z qx qy qz qw), moving objects."""
    chosen = np.unique(np.linspace(0, len(run.trajectory) - 1, min(POSES, len(run.trajectory))).astype(int))
    Ts = run.trajectory.Ts_world_camera[chosen]
    times = run.trajectory.timestamps[chosen]
    poses = [[*T[:3, 3].round(4).tolist(), *np.round(se3.rotation_to_quat_xyzw(T[:3, :3]), 5).tolist()] for T in Ts]
    camera = run.metrics.get("camera", {})
    movers = [
        [
            {"id": m.id, "box": m.box.round(3).tolist(), "speed": round(m.speed, 3)}
            for m in run.boxes.get(f"{t:.6f}", ())
        ]
        for t in times
    ]
    return {
        "camera": {key: camera[key] for key in ("fx", "fy", "cx", "cy", "width", "height") if key in camera},
        "times": times.round(6).tolist(),
        "poses": poses,
        "movers": movers,
    }


class ReportObserver(Thumbnails):
    """Keeps thumbnails and writes the report at the end."""

    def finish(self, out: Path) -> None:
        """Write report.html."""
        write_report(out)


def asset(name: str) -> Html:
    """Content of a file of the page folder."""
    return Html((files("dudmap.app.viewing") / "page" / name).read_text(encoding="utf-8"))


def _verdict(metrics: dict[str, Any]) -> str:
    tracked = f"{metrics.get('tracked', 0)} of {metrics.get('frames', 0)} frames were tracked"
    if metrics.get("complete"):
        return f"Processed to the end; {tracked}."
    return f"Incomplete: {metrics.get('stopped_by') or 'the run was stopped'}; {tracked}."


def _cards(metrics: dict[str, Any]) -> Html:
    return joined(
        html("<li><b>{value}</b><span>{label}</span></li>", value=form.format(factor * metrics[key]), label=label)
        for key, (label, factor, form) in CARDS.items()
        if isinstance(metrics.get(key), int | float)
    )


def _strip(run: RunFiles) -> Html:
    if not run.thumbnails:
        return Html("<p>This run kept no images (it was made with --no-report).</p>")
    start = float(next(iter(run.thumbnails)))
    columns = []
    for stamp, images in run.thumbnails.items():
        data = {kind: "data:image/jpeg;base64," + base64.b64encode(jpg).decode() for kind, jpg in images.items()}
        at = f"{float(stamp) - start:.1f} s"
        hidden = joined(
            html(' data-{kind}="{data}"', kind=kind, data=data[kind]) for kind in ("depth", "residuals") if kind in data
        )
        shown = joined(
            html('<img src="{data}" alt="{kind} at {at}" loading="lazy">', data=data[kind], kind=kind, at=at)
            for kind in ("color", "mask")
            if kind in data
        )
        figure = '<figure data-t="{stamp}"{hidden}>{shown}{at}</figure>'
        columns.append(html(figure, stamp=stamp, hidden=hidden, shown=shown, at=at))
    return html('<div class="strip">{columns}</div>', columns=joined(columns))


def _losses(metrics: dict[str, Any]) -> Html:
    lost, unreadable = metrics.get("lost_frames", []), metrics.get("unreadable_frames", [])
    notes = [
        (metrics.get("skipped_similar"), "redundant views have a pose but are not in the map"),
        (metrics.get("blind"), "images told too little: tracked by distances alone, they are not in the map"),
        (metrics.get("colorless"), "frames without colour were tracked by distances alone"),
        (metrics.get("uncertain"), "frames have uncertain poses or labels"),
        (metrics.get("degenerate"), "of them do not show all directions of motion"),
        (metrics.get("dropped"), "frames arrived too fast and were dropped"),
        ((metrics.get("maps") or 1) - 1, "submaps could not be joined with the main one"),
    ]
    rows: list[object] = [f"warning: {text}" for text in metrics.get("warnings", [])]
    rows += [f"{count} {text}" for count, text in notes if count]
    reasons: dict[str, list[float]] = {}
    for row in lost:
        reasons.setdefault(str(row["reason"]), []).append(float(row["timestamp"]))
    for reason, stamps in sorted(reasons.items(), key=lambda item: -len(item[1])):
        times = ", ".join(f"{stamp:.3f}" for stamp in stamps[:LISTED])
        more = f" and {len(stamps) - LISTED} more" if len(stamps) > LISTED else ""
        row = "{count} lost: {reason}<details><summary>times, s</summary>{times}{more}</details>"
        rows.append(html(row, count=len(stamps), reason=reason, times=times, more=more))
    rows += [f"unreadable: {text}" for text in unreadable[:LISTED]]
    if len(unreadable) > LISTED:
        rows.append(f"{len(unreadable) - LISTED} more frames were unreadable")
    if not rows:
        return Html("<p>Nothing: every frame was read and tracked, and every view is in the map.</p>")
    return html("<ul>{rows}</ul>", rows=joined(html("<li>{row}</li>", row=row) for row in rows))


def _stages(run: RunFiles) -> Html:
    if not run.stages:
        return Html("")
    times = {stage: float(run.column(stage).mean()) for stage in run.stages}
    excluded = {stage: times.pop(stage) for stage in NOT_INCLUDED if stage in times}
    ranked = sorted(times.items(), key=lambda item: -item[1])
    total = float(run.column("total").mean())
    ranked = ranked[: len(COLORS) - 1]
    parts = [*ranked, ("others", max(total - sum(ms for _, ms in ranked), 0.0))]
    part = '<span style="flex-grow:{ms:.3f};background:{color}" title="{name}"></span>'
    row = '<li><i style="background:{color}"></i>{name} <b>{ms:.1f} ms</b></li>'
    bar, legend = (
        joined(
            html(form, name=_words(name), ms=ms, color=color) for (name, ms), color in zip(parts, COLORS, strict=False)
        )
        for form in (part, row)
    )
    also = ", ".join(f"{_words(name)} {ms:.1f} ms" for name, ms in excluded.items())
    return html(
        '<p>Time per stage: {total:.1f} ms per frame on average{also}.</p><div class="bar">{bar}</div>'
        '<ul class="legend">{legend}</ul>',
        bar=bar, legend=legend, total=total, also=also and f"; not part of it: {also}",
    )  # fmt: skip


def _words(name: str) -> str:
    return printable(name)[:30].replace("_", " ")


def _table(metrics: dict[str, Any]) -> Html:
    row = "<tr><td>{name}</td><td>{value}</td></tr>"
    groups = joined(
        html(
            "<section><h3>{heading}</h3><table>{rows}</table></section>",
            heading=heading, rows=joined(html(row, name=name, value=value) for name, value in rows),
        )
        for heading, rows in metrics_table(metrics)
    )  # fmt: skip
    kept = {key: value for key, value in metrics.items() if key not in ("lost_frames", "unreadable_frames")}
    return html(
        '<div class="groups">{groups}</div><details><summary>metrics.json</summary><pre>{tree}</pre></details>',
        groups=groups, tree=json.dumps(kept, indent=2, ensure_ascii=False),
    )  # fmt: skip
