"""MCAP files with ROS 2 messages, which Foxglove opens without ROS."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dudmap.atomic_file import put_in_place
from dudmap.core.geometry import se3
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.extras import extra
from dudmap.io.exporting import ros_messages as ros
from dudmap.io.exporting.options import ExportOptions
from dudmap.io.exporting.run_content import RunContent

MESH_TRIANGLES = 50_000
"""Triangles of the mesh marker: viewers take every corner as a message of its own. The point cloud has all vertices."""


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write trajectory, surface and movers of a run.

    Topics: /tf (map to camera), /odometry, /path, /points (vertices of the mesh), /mesh and /movers. Path, points and
    mesh come at the time of the first pose.

    Raises:
        MissingExtraError: rosbags is not installed.
        OSError: The file cannot be written.
    """
    with extra("ros-bags", "writing .mcap"):
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_JAZZY)
    types = ros.MessageTypes(store.types.__getitem__)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
        bag = Path(folder) / "run"
        writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for topic, seconds, message in _messages(types, run):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], round(seconds * 1e9), store.serialize_cdr(message, kind))
        put_in_place(bag / "run.mcap", path)


def _messages(types: ros.MessageTypes, run: RunContent) -> Iterator[tuple[str, float, Any]]:
    """Topic, time and message of everything in a run, in order of time."""
    stamps, Ts, frame = run.trajectory.timestamps, run.trajectory.Ts_world_camera, ros.MAP_FRAME
    first = float(stamps[0])
    yield "/path", first, ros.path(types, first, stamps, Ts, frame)
    if run.mesh is not None:
        yield "/points", first, ros.cloud(types, first, run.mesh.vertices, run.mesh.colors, frame)
        yield "/mesh", first, ros.mesh_marker(types, first, simplified(run.mesh, MESH_TRIANGLES), frame)
    movers = {round(line["timestamp"], 6): line["movers"] for line in run.movers}
    before = first, Ts[0]
    had_movers = False
    for stamp, T in zip(stamps.tolist(), Ts, strict=True):
        elapsed = stamp - before[0]
        velocity = se3.log(se3.inverse(before[1]) @ T) / elapsed if elapsed > 0 else np.zeros(6)
        before = stamp, T
        yield "/tf", stamp, ros.transforms(types, [ros.transform(types, stamp, T, frame, ros.CAMERA_FRAME)])
        yield "/odometry", stamp, ros.odometry(types, stamp, T, velocity, frame, ros.CAMERA_FRAME)
        seen = movers.get(round(stamp, 6), [])
        if seen or had_movers:
            yield "/movers", stamp, ros.mover_markers(types, stamp, seen, frame)
        had_movers = bool(seen)
