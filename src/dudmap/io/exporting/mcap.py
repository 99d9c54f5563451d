"""MCAP files with ROS 2 messages, which Foxglove opens without ROS."""

import tempfile
from collections.abc import Iterator
from contextlib import closing
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


class McapWriter:
    """A new bag of ROS 2 with one MCAP file.

    Args:
        folder: Of the bag; it must not exist.
        purpose: What needs the package rosbags, for the message that it is missing.
        compressed: Whether the file is compressed by zstd.

    Attributes:
        types: Message classes.
        file: The MCAP file, complete when the writer is closed.

    Raises:
        MissingExtraError: rosbags is not installed.
        OSError: The folder cannot be made.
    """

    def __init__(self, folder: Path, purpose: str, *, compressed: bool) -> None:
        with extra("ros-bags", purpose):
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self.types, self.file = ros.MessageTypes(self._store.types.__getitem__), folder / f"{folder.name}.mcap"
        self._connections: dict[str, Any] = {}
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compressed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()

    def write(self, topic: str, nanoseconds: int, message: Any) -> None:  # noqa: ANN401
        """Write a message with its time of recording."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._connections[topic], nanoseconds, self._store.serialize_cdr(message, kind))

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write trajectory, surface and movers of a run.

    Topics: /tf (map to camera), /odometry, /path, /points (vertices of the mesh), /mesh and /movers. Path, points and
    mesh come at the time of the first pose.
    """
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
        with closing(McapWriter(Path(folder) / "run", "writing .mcap", compressed=True)) as writer:
            for topic, seconds, message in _messages(writer.types, run):
                writer.write(topic, round(seconds * 1e9), message)
        put_in_place(writer.file, path)


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
