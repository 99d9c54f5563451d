"""ROS 2 messages from and to arrays, and MCAP files. The caller passes message classes (rosbags or rclpy).

Frames: ``map`` (REP 105); ``camera``, x right, y down, z forward (REP 103). Unsupported messages raise a
``DatasetError``.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dudmap.atomic_file import put_in_place
from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.mesh import Mesh
from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.errors import DatasetError
from dudmap.extras import extra
from dudmap.io.exporting.run_content import ExportOptions, RunContent

MAP_FRAME, CAMERA_FRAME = "map", "camera"
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
"""A point of a cloud: metres, and colour as 0x00RRGGBB in a field ``rgb``."""
FLOAT32 = 7
"""``sensor_msgs/PointField.FLOAT32``, also of the packed colour by convention."""
TRIANGLE_LIST, CUBE, ADD, DELETE_ALL = 11, 1, 0, 3
"""Constants of ``visualization_msgs/Marker``."""


@dataclass(frozen=True)
class MessageTypes:
    """Access to message classes.

    Attributes:
        find: Class of a type such as ``nav_msgs/msg/Path``, with fields as keywords.
        octets: Bytes of an array as a field ``uint8[]``.
    """

    find: Callable[[str], Any]
    octets: Callable[[NDArray], Any] = lambda array: np.frombuffer(array.tobytes(), np.uint8)

    def make(self, kind: str, /, **fields: Any) -> Any:  # noqa: ANN401
        """Message of a type."""
        return self.find(kind)(**fields)


# -- to messages -------------------------------------------------------------------------------------------------------


def time_message(types: MessageTypes, seconds: float, name: str = "Time") -> Any:  # noqa: ANN401
    """``builtin_interfaces/Time`` (or ``Duration``) of seconds."""
    nanoseconds = round(seconds * 1e9)
    return types.make(f"builtin_interfaces/msg/{name}", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def header(types: MessageTypes, seconds: float, frame: str) -> Any:  # noqa: ANN401
    """``std_msgs/Header``."""
    return types.make("std_msgs/msg/Header", stamp=time_message(types, seconds), frame_id=frame)


def vector(types: MessageTypes, xyz: Sequence[float] | NDArray, name: str = "Vector3") -> Any:  # noqa: ANN401
    """``geometry_msgs/Vector3`` (or ``Point``)."""
    x, y, z = (float(value) for value in xyz)
    return types.make(f"geometry_msgs/msg/{name}", x=x, y=y, z=z)


def rotation(types: MessageTypes, R: NDArray[np.float64]) -> Any:  # noqa: ANN401
    """``geometry_msgs/Quaternion`` of a rotation (3, 3)."""
    x, y, z, w = (float(value) for value in se3.rotation_to_quat_xyzw(R))
    return types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def pose(types: MessageTypes, T: NDArray[np.float64]) -> Any:  # noqa: ANN401
    """``geometry_msgs/Pose`` of a rigid motion (4, 4)."""
    return types.make(
        "geometry_msgs/msg/Pose", position=vector(types, T[:3, 3], "Point"), orientation=rotation(types, T[:3, :3])
    )


def transform(types: MessageTypes, seconds: float, T_parent_child: NDArray[np.float64], parent: str, child: str) -> Any:  # noqa: ANN401
    """``geometry_msgs/TransformStamped``: the pose (4, 4) of ``child`` in ``parent``."""
    T = T_parent_child
    motion = types.make(
        "geometry_msgs/msg/Transform", translation=vector(types, T[:3, 3]), rotation=rotation(types, T[:3, :3])
    )
    return types.make(
        "geometry_msgs/msg/TransformStamped",
        header=header(types, seconds, parent), child_frame_id=child, transform=motion,
    )  # fmt: skip


def transforms(types: MessageTypes, stamped: Sequence[Any]) -> Any:  # noqa: ANN401
    """``tf2_msgs/TFMessage`` of stamped transforms."""
    return types.make("tf2_msgs/msg/TFMessage", transforms=list(stamped))


def odometry(
    types: MessageTypes,
    seconds: float,
    T: NDArray[np.float64],
    covariance: NDArray[np.float64] | None,
    velocity: NDArray[np.float64],
    parent: str,
    child: str,
) -> Any:  # noqa: ANN401
    """``nav_msgs/Odometry`` of a pose (4, 4), its covariance (6, 6) in world axes, and a twist (6,) per second in
    camera axes; covariances of 0 are unknown."""
    twist = types.make(
        "geometry_msgs/msg/Twist", linear=vector(types, velocity[:3]), angular=vector(types, velocity[3:])
    )
    unknown = np.zeros(36)
    known = unknown if covariance is None else covariance.ravel()
    return types.make(
        "nav_msgs/msg/Odometry",
        header=header(types, seconds, parent),
        child_frame_id=child,
        pose=types.make("geometry_msgs/msg/PoseWithCovariance", pose=pose(types, T), covariance=known),
        twist=types.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
    )


def path(types: MessageTypes, seconds: float, stamps: Sequence[float] | NDArray, Ts: NDArray, frame: str) -> Any:  # noqa: ANN401
    """``nav_msgs/Path`` of poses (n, 4, 4) at times (n,)."""
    poses = [
        types.make("geometry_msgs/msg/PoseStamped", header=header(types, float(stamp), frame), pose=pose(types, T))
        for stamp, T in zip(stamps, Ts, strict=True)
    ]
    return types.make("nav_msgs/msg/Path", header=header(types, seconds, frame), poses=poses)


def cloud(types: MessageTypes, seconds: float, points: NDArray, colors: NDArray[np.uint8], frame: str) -> Any:  # noqa: ANN401
    """``sensor_msgs/PointCloud2`` of points (n, 3), metres, with colours (n, 3)."""
    rows = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    red, green, blue = colors.astype(np.uint32).T
    rows["rgb"] = (red << 16) | (green << 8) | blue
    fields = [
        types.make("sensor_msgs/msg/PointField", name=name, offset=4 * number, datatype=FLOAT32, count=1)
        for number, name in enumerate(("x", "y", "z", "rgb"))
    ]
    return types.make(
        "sensor_msgs/msg/PointCloud2",
        header=header(types, seconds, frame), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=POINT.itemsize, row_step=POINT.itemsize * len(points), data=types.octets(rows), is_dense=True,
    )  # fmt: skip


def image(types: MessageTypes, seconds: float, pixels: NDArray, encoding: str, frame: str) -> Any:  # noqa: ANN401
    """``sensor_msgs/Image`` of an array (H, W) or (H, W, 3) in the encoding's layout."""
    height, width = pixels.shape[:2]
    return types.make(
        "sensor_msgs/msg/Image",
        header=header(types, seconds, frame), height=height, width=width, encoding=encoding, is_bigendian=0,
        step=pixels.nbytes // height, data=types.octets(pixels),
    )  # fmt: skip


def camera_info(types: MessageTypes, seconds: float, camera: Camera, frame: str) -> Any:  # noqa: ANN401
    """``sensor_msgs/CameraInfo`` of a camera."""
    P, D = np.zeros((3, 4)), np.zeros(5)
    P[:, :3], D[: len(camera.distortion)] = camera.K, camera.distortion
    whole = types.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.make(
        "sensor_msgs/msg/CameraInfo",
        header=header(types, seconds, frame), height=camera.height, width=camera.width, distortion_model="plumb_bob",
        d=D, k=camera.K.reshape(-1), r=np.eye(3).reshape(-1), p=P.reshape(-1), binning_x=0, binning_y=0, roi=whole,
    )  # fmt: skip


def mesh_marker(types: MessageTypes, seconds: float, mesh: Mesh, frame: str) -> Any:  # noqa: ANN401
    """``visualization_msgs/Marker`` with a mesh, coloured by vertex."""
    corners = mesh.faces.reshape(-1)
    find_point, find_color = types.find("geometry_msgs/msg/Point"), types.find("std_msgs/msg/ColorRGBA")
    points = [find_point(x=x, y=y, z=z) for x, y, z in mesh.vertices[corners].astype(float).tolist()]
    shades = (mesh.colors[corners] / 255).tolist()
    colors = [find_color(r=r, g=g, b=b, a=1.0) for r, g, b in shades]
    return _marker(types, seconds, frame, "mesh", 0, TRIANGLE_LIST, points=points, colors=colors)


def mover_markers(types: MessageTypes, seconds: float, movers: Sequence[Mapping[str, Any]], frame: str) -> Any:  # noqa: ANN401
    """``visualization_msgs/MarkerArray`` with the boxes of moving objects; older ones are removed.

    Args:
        movers: Objects with ``id`` and ``box`` (corners, metres), as in movers.jsonl.
    """
    markers = [_marker(types, seconds, frame, "movers", 0, CUBE, action=DELETE_ALL)]
    for mover in movers:
        low, high = np.asarray(mover["box"], float)
        T = np.eye(4)
        T[:3, 3] = (low + high) / 2
        scale = vector(types, np.maximum(high - low, 0.01))
        markers.append(_marker(types, seconds, frame, "movers", int(mover["id"]), CUBE, T=T, scale=scale, alpha=0.4))
    return types.make("visualization_msgs/msg/MarkerArray", markers=markers)


def _marker(
    types: MessageTypes,
    seconds: float,
    frame: str,
    namespace: str,
    number: int,
    kind: int,
    *,
    T: NDArray[np.float64] | None = None,
    alpha: float = 1.0,
    **fields: Any,  # noqa: ANN401
) -> Any:  # noqa: ANN401
    empty = types.octets(np.zeros(0, np.uint8))
    common: dict[str, Any] = {
        "header": header(types, seconds, frame), "ns": namespace, "id": number, "type": kind, "action": ADD,
        "pose": pose(types, np.eye(4) if T is None else T), "scale": vector(types, (1, 1, 1)),
        "color": types.make("std_msgs/msg/ColorRGBA", r=1.0, g=0.3, b=0.1, a=alpha),
        "lifetime": time_message(types, 0.0, "Duration"), "frame_locked": False, "points": [], "colors": [],
        "texture_resource": "", "uv_coordinates": [], "text": "", "mesh_resource": "",
        "texture": types.make(
            "sensor_msgs/msg/CompressedImage", header=header(types, seconds, frame), format="", data=empty
        ),
        "mesh_file": types.make("visualization_msgs/msg/MeshFile", filename="", data=empty),
        "mesh_use_embedded_materials": False,
    }  # fmt: skip
    return types.make("visualization_msgs/msg/Marker", **(common | fields))


# -- from messages -----------------------------------------------------------------------------------------------------


def seconds_of(message: Any) -> float:  # noqa: ANN401
    """Time of a message's header, seconds."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def camera_of(message: Any) -> Camera:  # noqa: ANN401
    """Camera of a ``sensor_msgs/CameraInfo``."""
    k = [float(value) for value in message.k]
    d = tuple(float(value) for value in message.d)
    if k[0] <= 0 or k[4] <= 0:
        raise DatasetError(
            "the camera_info has no focal length; calibrate the camera or set its intrinsics in the driver"
        )
    if any(d) and (message.distortion_model not in ("plumb_bob", "rational_polynomial") or any(d[5:])):
        raise DatasetError(
            f"the distortion model {message.distortion_model!r} is not supported; rectify the images first"
        )
    distortion = d[:5] if any(d) else ()
    return Camera(k[0], k[4], k[2], k[5], int(message.width), int(message.height), distortion=distortion)


MESH_TRIANGLES = 50_000
"""Triangles of the mesh marker: viewers treat every corner as a message."""


class McapWriter:
    """A new bag of ROS 2 with one MCAP file.

    Args:
        folder: New folder of the bag.
        compressed: By zstd.

    Attributes:
        file: The MCAP file, complete when closed.

    Raises:
        MissingExtraError: rosbags is not installed.
        OSError: The folder cannot be made.
    """

    def __init__(self, folder: Path, purpose: str, *, compressed: bool) -> None:
        with extra("ros-bags", purpose):
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self.types, self.file = MessageTypes(self._store.types.__getitem__), folder / f"{folder.name}.mcap"
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

    def flush(self) -> int:
        """Write the current chunk, so that it is readable if the file is never closed; returns the file's handle."""
        storage: Any = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
            storage.bio.flush()
        return storage.bio.fileno()

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()


def write(run: RunContent, path: Path, options: ExportOptions) -> None:
    """Write trajectory, surface and movers: /tf (map to camera), /odometry, /path, /points, /mesh and /movers.

    Path, points and mesh have the time of the first pose.
    """
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
        with closing(McapWriter(Path(folder) / "run", "writing .mcap", compressed=True)) as writer:
            for topic, seconds, message in _messages(writer.types, run):
                writer.write(topic, round(seconds * 1e9), message)
        put_in_place(writer.file, path)


def _messages(types: MessageTypes, run: RunContent) -> Iterator[tuple[str, float, Any]]:
    stamps, Ts, frame = run.trajectory.timestamps, run.trajectory.Ts_world_camera, MAP_FRAME
    first = float(stamps[0])
    yield "/path", first, path(types, first, stamps, Ts, frame)
    if run.mesh is not None:
        yield "/points", first, cloud(types, first, run.mesh.vertices, run.mesh.colors, frame)
        yield "/mesh", first, mesh_marker(types, first, simplified(run.mesh, MESH_TRIANGLES), frame)
    movers = {round(line["timestamp"], 6): line["movers"] for line in run.movers}
    before = first, Ts[0]
    had_movers = False
    for stamp, T in zip(stamps.tolist(), Ts, strict=True):
        elapsed = stamp - before[0]
        velocity = se3.log(se3.inverse(before[1]) @ T) / elapsed if elapsed > 0 else np.zeros(6)
        before = stamp, T
        yield "/tf", stamp, transforms(types, [transform(types, stamp, T, frame, CAMERA_FRAME)])
        yield "/odometry", stamp, odometry(types, stamp, T, None, velocity, frame, CAMERA_FRAME)
        seen = movers.get(round(stamp, 6), [])
        if seen or had_movers:
            yield "/movers", stamp, mover_markers(types, stamp, seen, frame)
        had_movers = bool(seen)
