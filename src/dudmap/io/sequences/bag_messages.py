"""Interpret the messages of a bag: topics, the frame tree of /tf, images.

Missing or ambiguous topics raise a ``DatasetError``; other encodings and damage a ``FrameError``.
"""

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.io.sequences import images

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
KEYS = ("color", "depth", "color_info", "depth_info", "world")
"""Keys of ``--topics``."""
TRANSPORTS = ("compressed", "compressedDepth")
"""Last parts of image_transport's topics."""
DEPTH_NAME = re.compile(r"depth")
COLOR_NAME = re.compile(r"rgb|colou?r|image|video|left")
OTHER_NAME = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|right|gray|mono|theora|mask|label|points")
REGISTERED_NAME = re.compile(r"aligned|depth_registered|depth_to_(rgb|color)|hw_registered|sw_registered")


class Topics(NamedTuple):
    """Connections of images and camera_info, and the world frame; without colour both images are depth."""

    color: "Connection"
    depth: "Connection"
    color_info: "Connection | None"
    depth_info: "Connection | None"
    world: str = "world"

    @property
    def registered(self) -> bool:
        """Whether the depth topic's name says registered."""
        return bool(REGISTERED_NAME.search(self.depth.topic))


def chosen_topics(text: str | None) -> dict[str, str]:
    """Chosen topics of ``color=/a,depth=/b`` by key."""
    chosen = {}
    for part in (text or "").split(","):
        key, found, value = (piece.strip() for piece in part.partition("="))
        if not part.strip():
            continue
        if not found or key not in KEYS or not value:
            raise DatasetError(
                f"cannot understand --topics {part!r}; expected {', '.join(f'{key}=...' for key in KEYS)}"
            )
        chosen[key] = value
    return chosen


def find_topics(
    connections: "Sequence[Connection]", chosen: dict[str, str], bag: str, first: "Callable[[Connection], Any]"
) -> Topics:
    """Chosen topics, else by names, else by encodings; ``first`` gives the first message of a topic."""
    filled = [connection for connection in connections if connection.msgcount > 0]
    images = [connection for connection in filled if connection.msgtype in IMAGES]
    depths = [_named(images, chosen["depth"], bag)] if "depth" in chosen else [c for c in images if _is_depth(c)]
    colors = [_named(images, chosen["color"], bag)] if "color" in chosen else [c for c in images if _is_color(c)]
    if not (depths and colors):
        open_to = [c for c in images if c not in depths and not OTHER_NAME.search(c.topic.lower())]
        kinds = {connection.topic: _kind(first(connection)) for connection in open_to}
        if not depths:
            depths = [connection for connection in open_to if kinds[connection.topic] == "depth"]
            colors = [connection for connection in colors if connection not in depths]
        colors = colors or [connection for connection in open_to if kinds[connection.topic] == "colour"]
    others = (c for c in images if c not in depths and not _is_depth(c) and not OTHER_NAME.search(c.topic.lower()))
    alone = "color" not in chosen and not colors and next(others, None) is None
    for wanted, found in (("depth", depths), ("colour", depths if alone else colors)):
        if not found:
            raise DatasetError(
                f"no topic of {bag} is recognised as {wanted} images; it holds {_listed(images or filled)}; choose "
                "with --topics color=/...,depth=/..."
            )
    pairs = [(color, depth) for color in colors for depth in depths if color is not depth]
    color, depth = _best([(depth, depth) for depth in depths] if alone else pairs, images, bag)
    infos = [connection for connection in filled if connection.msgtype == INFO]
    return Topics(
        color,
        depth,
        _named(infos, chosen["color_info"], bag) if "color_info" in chosen else _info_of(color, infos),
        _named(infos, chosen["depth_info"], bag) if "depth_info" in chosen else _info_of(depth, infos),
        chosen.get("world", "world"),
    )


def base(topic: str) -> str:
    """Topic without the name of the transport."""
    head, _, last = topic.rpartition("/")
    return head if last in TRANSPORTS else topic


def _best(
    pairs: "list[tuple[Connection, Connection]]", images: "Sequence[Connection]", bag: str
) -> "tuple[Connection, Connection]":
    def score(pair: "tuple[Connection, Connection]") -> tuple[int, ...]:
        color, depth = pair
        left, right = base(color.topic).split("/"), base(depth.topic).split("/")
        shared = next((k for k, (a, b) in enumerate(zip(left, right, strict=False)) if a != b), len(left))
        named = bool(re.search(r"rgb|colou?r", color.topic))
        return (
            shared,
            bool(REGISTERED_NAME.search(depth.topic)),
            named,
            "rect" in depth.topic,
            "rect" in color.topic,
            base(depth.topic) == depth.topic,
            base(color.topic) == color.topic,
        )

    ranked = sorted(pairs, key=score, reverse=True)
    if not ranked:
        raise DatasetError(f"{bag} holds depth but no matching colour images: {_listed(images)}")
    if len(ranked) > 1 and score(ranked[0]) == score(ranked[1]):
        raise DatasetError(
            f"several topics of {bag} fit equally: {_listed(images)}; choose with --topics color=/...,depth=/..."
        )
    return ranked[0]


def _info_of(image: "Connection", infos: "Sequence[Connection]") -> "Connection | None":
    """The camera_info of an image, as by image_transport, or in ``info``."""
    parent = base(image.topic).rpartition("/")[0]
    names = (f"{parent}/camera_info", f"{parent.removesuffix('/image')}/info/camera_info")
    return next((info for name in names for info in infos if info.topic == name), None)


def _is_depth(connection: "Connection") -> bool:
    name = connection.topic.lower()
    return bool(DEPTH_NAME.search(name)) and not OTHER_NAME.search(name)


def _is_color(connection: "Connection") -> bool:
    name = connection.topic.lower()
    return bool(COLOR_NAME.search(name)) and not DEPTH_NAME.search(name) and not OTHER_NAME.search(name)


def _kind(image: Any) -> str:  # noqa: ANN401 - the type is made from the bag
    if hasattr(image, "format"):
        form = image.format.lower()
        return "depth" if "compresseddepth" in form else "colour" if re.match(r"(rgb|bgr)a?8|jpe?g", form) else ""
    if image.encoding in ("16UC1", "32FC1"):  # infrared images may be mono16
        return "depth"
    return "colour" if image.encoding in COLOR_ENCODINGS and image.encoding not in ("mono8", "8UC1") else ""


def _named(connections: "Sequence[Connection]", topic: str, bag: str) -> "Connection":
    for connection in connections:
        if connection.topic == topic:
            return connection
    raise DatasetError(f"there is no such topic {topic} in {bag}; it holds {_listed(connections)}")


def _listed(connections: "Iterable[Connection]") -> str:
    parts = [f"{connection.topic} ({connection.msgcount} {connection.msgtype})" for connection in connections]
    return ", ".join(parts) or "no topics of that type"


STATIC_TOPIC, TOPIC = "/tf_static", "/tf"
LARGEST_GAP = 0.2
"""Longest interpolated gap, seconds: one miss at 10 Hz."""


class TransformTree:
    """Motions between named frames: one parent each, by time or static. Names lack tf's leading slash."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._motions: dict[str, dict[float, NDArray[np.float64]]] = {}

    def add(self, messages: Iterable[Any], *, static: bool) -> None:
        """Add tf messages; static ones replace others of their frame."""
        for stamped in (stamped for message in messages for stamped in message.transforms):
            child, stamp = stamped.child_frame_id.lstrip("/"), stamped.header.stamp
            self._parents[child] = stamped.header.frame_id.lstrip("/")
            motions = {} if static else self._motions.get(child, {})
            motions[stamp.sec + 1e-9 * stamp.nanosec] = motion_of(stamped.transform)
            self._motions[child] = motions

    def between(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Motion (4, 4) of points of ``source`` into ``target`` along static frames, or None."""
        up, down = self._path(source), self._path(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        T_common_source, T_common_target = (self._fixed(path[: path.index(common)]) for path in (up, down))
        if T_common_source is None or T_common_target is None:
            return None
        return se3.inverse(T_common_target) @ T_common_source

    def reaches(self, world: str, frame: str) -> bool:
        """Whether ``frame`` is a descendant of ``world``."""
        return world.lstrip("/") in self._path(frame)[1:]

    def trajectory(self, world: str, frame: str, stamps: NDArray[np.float64]) -> Trajectory | None:
        """Poses of ``frame`` in ``world`` at the times (N,) that all motions cover, on screws."""
        path = self._path(frame)
        if world.lstrip("/") not in path:
            return None
        series = []
        for child in path[: path.index(world.lstrip("/"))]:
            times = sorted(self._motions[child])
            series.append((np.array(times), np.array([self._motions[child][time] for time in times])))
        poses = []
        for stamp in stamps:
            T = np.eye(4)
            for times, Ts in series:
                link = _at(times, Ts, stamp)
                if link is None:
                    break
                T = link @ T
            else:
                poses.append((float(stamp), T))
        return Trajectory.from_poses(poses) if poses else None

    def _path(self, frame: str) -> list[str]:
        path = [frame.lstrip("/")]
        while (parent := self._parents.get(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def _fixed(self, children: list[str]) -> NDArray[np.float64] | None:
        T = np.eye(4)
        for child in children:
            link, *others = self._motions[child].values()
            if not all(np.allclose(link, other, atol=1e-6) for other in others):
                return None
            T = link @ T
        return T


def _at(times: NDArray[np.float64], Ts: NDArray[np.float64], stamp: float) -> NDArray[np.float64] | None:
    if len(times) == 1:
        return Ts[0]
    k = int(np.searchsorted(times, stamp, side="right"))
    if k == 0 or stamp > times[-1] or times[min(k, len(times) - 1)] - times[k - 1] > LARGEST_GAP:
        return None
    return se3.interpolate_in_time(times, Ts, float(stamp))


def motion_of(transform: Any) -> NDArray[np.float64]:  # noqa: ANN401 - the type is made from its definition
    """Motion (4, 4) of a geometry_msgs/Transform."""
    T = np.eye(4)
    r, t = transform.rotation, transform.translation
    T[:3, :3] = se3.quat_xyzw_to_rotation(np.array([r.x, r.y, r.z, r.w]))
    T[:3, 3] = t.x, t.y, t.z
    return T


COLOR_ENCODINGS = {
    "rgb8": (3, ""), "8UC3": (3, "COLOR_BGR2RGB"), "bgr8": (3, "COLOR_BGR2RGB"), "rgba8": (4, "COLOR_RGBA2RGB"),
    "bgra8": (4, "COLOR_BGRA2RGB"), "8UC4": (4, "COLOR_BGRA2RGB"), "mono8": (1, "COLOR_GRAY2RGB"),
    "8UC1": (1, "COLOR_GRAY2RGB"), "yuv422": (2, "COLOR_YUV2RGB_UYVY"), "uyvy": (2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2RGB_YUY2"), "yuyv": (2, "COLOR_YUV2RGB_YUY2"),
    "bayer_rggb8": (1, "COLOR_BayerRGGB2RGB"), "bayer_bggr8": (1, "COLOR_BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "COLOR_BayerGBRG2RGB"), "bayer_grbg8": (1, "COLOR_BayerGRBG2RGB"),
}  # fmt: skip
"""Channels and OpenCV's conversion to RGB by encoding (sensor_msgs/image_encodings)."""
DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encoding to type: 16-bit millimetres, or float metres (ROS REP 118)."""
COMPRESSED_DEPTH_HEADER = struct.Struct("<i2f")
"""Format and two quantisation parameters before the PNG (compressed_depth_image_transport)."""


def color_of(message: Any, name: str) -> NDArray[np.uint8]:  # noqa: ANN401 - the type is made from the bag
    """Colour image (H, W, 3), RGB, of an Image or CompressedImage; ``name`` is used in messages."""
    import cv2

    if hasattr(message, "format"):
        return images.decode_color(message.data, name)
    if message.encoding not in COLOR_ENCODINGS:
        raise FrameError(
            f"{name} is encoded as {message.encoding}; expected one of {', '.join(sorted(COLOR_ENCODINGS))}"
        )
    channels, conversion = COLOR_ENCODINGS[message.encoding]
    pixels = _pixels(message, np.dtype("u1"), channels, name)
    if not conversion:
        return pixels.copy()
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), np.uint8)


def depth_of(message: Any, depth_scale: float, name: str) -> NDArray[np.float32]:  # noqa: ANN401
    """Depth image (H, W), metres, 0 = missing, of an Image or CompressedImage; ``name`` is used in messages."""
    if hasattr(message, "format"):
        return _compressed_depth(message, depth_scale, name)
    if message.encoding not in DEPTH_ENCODINGS:
        raise FrameError(
            f"{name} is encoded as {message.encoding}; expected one of {', '.join(sorted(DEPTH_ENCODINGS))}"
        )
    order = ">" if message.is_bigendian else "<"
    pixels = _pixels(message, np.dtype(order + DEPTH_ENCODINGS[message.encoding]), 1, name)
    return images.metres(pixels.astype(pixels.dtype.newbyteorder("=")), depth_scale, name)


def _pixels(message: Any, kind: np.dtype, channels: int, name: str) -> NDArray[Any]:  # noqa: ANN401
    used = message.width * channels * kind.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if message.step < used or len(data) < message.step * message.height:
        raise FrameError(
            f"{name} has {len(data)} bytes in rows of {message.step}; expected {message.height} rows of {used}"
        )
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :used]
    shape = (message.height, message.width) if channels == 1 else (message.height, message.width, channels)
    return np.ascontiguousarray(rows).view(kind).reshape(shape)


def _compressed_depth(message: Any, depth_scale: float, name: str) -> NDArray[np.float32]:  # noqa: ANN401
    """Depth of PNG or RVL; floats are 16-bit inverse depths q, z = a / (q - b), a and b in the header."""
    data = bytes(message.data)
    if data.startswith(images.PNG):
        return images.decode_depth(data, depth_scale, name)
    floats, body = message.format.startswith("32FC1"), data[COMPRESSED_DEPTH_HEADER.size :]
    scale = 1.0 if floats else depth_scale
    if body.startswith(images.PNG):
        stored = images.decode_depth(body, scale, name)
    elif message.format.lower().endswith("rvl"):
        from dudmap.core.backends.cpu import rvl  # its kernel is not needed for other bags

        steps = rvl.decompressed(body)
        if steps is None:
            raise FrameError(f"{name} is no complete RVL image: {len(data)} bytes")
        stored = images.metres(steps, scale, name)
    else:
        said = f"{name} is compressed as {message.format!r}; expected PNG or RVL, so republish it as raw images"
        raise FrameError(said)
    if not floats:
        return stored
    _, a, b = COMPRESSED_DEPTH_HEADER.unpack_from(data)
    with np.errstate(divide="ignore"):
        depth = np.float32(a) / (stored - np.float32(b))
    return images.metres(np.where(stored > 0, depth, np.float32(0)), 1.0, name)
