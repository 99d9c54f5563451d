"""Metrics of a run in groups, with units."""

from typing import Any, NamedTuple

Table = list[tuple[str, list[tuple[str, str]]]]


class Named(NamedTuple):
    """Name, format with unit, and factor of a metric."""

    name: str
    form: str = "{:.0f}"
    factor: float = 1.0


GROUPS = {
    "Accuracy": {
        "ate_rmse_m": Named("absolute trajectory error (ATE), RMSE", "{:.1f} mm", 1000),
        "ate_rot_rmse_deg": Named("orientation error after this alignment, RMSE", "{:.2f} deg"),
        "rpe_trans_rmse_m_per_s": Named("relative error (RPE) over one second, translation, RMSE", "{:.1f} mm", 1000),
        "rpe_rot_rmse_deg_per_s": Named("relative error (RPE) over one second, rotation, RMSE", "{:.2f} deg"),
        "accuracy_missing": Named("no accuracy, because"),
        "mask_iou_mean": Named("dynamic masks, mean IoU", "{:.3f}"),
        "mask_iou_frames": Named("frames with a scored mask"),
    },
    "Frames": {
        "frames": Named("frames"),
        "tracked": Named("tracked"),
        "repeated": Named("repeat the frame before"),
        "lost": Named("lost"),
        "relocalized": Named("relocalised"),
        "corrected": Named("loop closures and joined submaps"),
        "fused": Named("changed the map"),
        "skipped_similar": Named("redundant views"),
        "uncertain": Named("uncertain poses or labels"),
        "blind": Named("images told too little"),
        "colorless": Named("without colour"),
        "degenerate": Named("not all directions of motion observable"),
        "unreadable": Named("unreadable"),
        "dropped": Named("dropped"),
        "shed.movers": Named("without moving objects, for lack of time"),
        "shed.labels": Named("with the labels of the frame before, for lack of time"),
        "shed.fusion": Named("not fused, for lack of time"),
        "frames_with_mask": Named("with an external mask"),
        "frames_without_mask": Named("without an external mask"),
        "dynamic_share_mean": Named("readings that move, mean", "{:.1f} %", 100),
        "readings.too_near": Named("readings nearer than the depth range", "{:.1f} %", 100),
        "readings.too_far": Named("readings beyond the depth range", "{:.1f} %", 100),
    },
    "Map": {
        "mesh_triangles": Named("triangles of the mesh"),
        "mesh_vertices": Named("vertices of the mesh"),
        "maps": Named("separate maps"),
        "map_blocks": Named("blocks of 8x8x8 voxels"),
        "map_bytes": Named("size of the map", "{:.1f} MB", 1e-6),
    },
    "Time and memory": {
        "ms_per_frame_median": Named("per frame, median", "{:.1f} ms"),
        "ms_per_frame_p95": Named("per frame, 95 % quantile", "{:.1f} ms"),
        "ms_reading_median": Named("reading a frame, median", "{:.1f} ms"),
        "latency_ms_median": Named("from arrival to result, median", "{:.1f} ms"),
        "latency_ms_p95": Named("from arrival to result, 95 % quantile", "{:.1f} ms"),
        "wall_s": Named("whole run", "{:.1f} s"),
        "cpu_s": Named("processor time", "{:.1f} s"),
        "peak_rss_mb": Named("peak memory", "{:.0f} MB"),
    },
    "Run": {
        "command": Named("command"),
        "date": Named("finished"),
        "recording.path": Named("recording"),
        "sources.intrinsics": Named("intrinsics"),
        "sources.depth unit": Named("depth unit"),
        "sources.times": Named("times"),
        "sources.frames": Named("pairs of images"),
        "camera.width": Named("image width", "{:.0f} px"),
        "camera.height": Named("image height", "{:.0f} px"),
        "camera.fx": Named("focal length", "{:.1f} px"),
        "calibration.estimated": Named("estimated calibration"),
        "device": Named("device"),
        "machine.cpu": Named("processor"),
        "machine.cores_usable": Named("cores"),
        "machine.os": Named("operating system"),
        "versions.dudmap": Named("dudmap"),
        "versions.python": Named("Python"),
    },
}


def metrics_table(metrics: dict[str, Any]) -> Table:
    """The known metrics, in groups."""
    groups = []
    for heading, named in GROUPS.items():
        found = [(one, _value(metrics, key)) for key, one in named.items()]
        rows = [(one.name, _text(value, one)) for one, value in found if value not in (None, [], "")]
        if rows:
            groups.append((heading, rows))
    return groups


def _value(metrics: dict[str, Any], key: str) -> Any:  # noqa: ANN401 - of any type that JSON has
    head, _, rest = key.partition(".")
    value = metrics.get(head)
    return value if not rest else _value(value, rest) if isinstance(value, dict) else None


def _text(value: object, named: Named) -> str:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return named.form.format(named.factor * value)
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
