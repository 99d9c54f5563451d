"""Recognition of the colour, depth and calibration topics of a bag by their types and names.

Topics that are missing or not to be told apart are a ``DatasetError``, whose sentence lists those that are there.
"""

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from dudmap.errors import DatasetError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
KEYS = ("color", "depth", "color_info", "depth_info", "world")
"""What ``--topics`` can name: the topics of the images, those of their camera_info, and the world frame of /tf."""
TRANSPORTS = ("compressed", "compressedDepth")
"""Last parts of the topics that image_transport adds for its encodings."""
DEPTH_NAME = re.compile(r"depth")
COLOR_NAME = re.compile(r"rgb|colou?r|image|video|left")
OTHER_NAME = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|confidence|disparity|right|gray|mono|theora|mask|label|points")
REGISTERED_NAME = re.compile(r"aligned|depth_registered|depth_to_(rgb|color)|hw_registered|sw_registered")


class Topics(NamedTuple):
    """Connections of the two images and, where there are any, of their camera_info; and the world frame of /tf."""

    color: "Connection"
    depth: "Connection"
    color_info: "Connection | None"
    depth_info: "Connection | None"
    world: str = "world"

    @property
    def registered(self) -> bool:
        """Whether the name of the depth topic says that it is registered to colour."""
        return bool(REGISTERED_NAME.search(self.depth.topic))


def parse(text: str | None) -> dict[str, str]:
    """The chosen topics ``color=/a,depth=/b`` by key."""
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


def find(connections: "Sequence[Connection]", chosen: dict[str, str], bag: str) -> Topics:
    """Topics that are chosen, and for the rest those that are recognised."""
    filled = [connection for connection in connections if connection.msgcount > 0]
    images = [connection for connection in filled if connection.msgtype in IMAGES]
    depths = [_named(images, chosen["depth"], bag)] if "depth" in chosen else [c for c in images if _is_depth(c)]
    colors = [_named(images, chosen["color"], bag)] if "color" in chosen else [c for c in images if _is_color(c)]
    for wanted, found in (("depth", depths), ("colour", colors)):
        if not found:
            raise DatasetError(
                f"no topic of {bag} is recognised as {wanted} images; it holds {_listed(images or filled)}; choose "
                "with --topics color=/...,depth=/..."
            )
    color, depth = _best([(color, depth) for color in colors for depth in depths if color is not depth], images, bag)
    infos = [connection for connection in filled if connection.msgtype == INFO]
    return Topics(
        color,
        depth,
        _named(infos, chosen["color_info"], bag) if "color_info" in chosen else _info_of(color, infos),
        _named(infos, chosen["depth_info"], bag) if "depth_info" in chosen else _info_of(depth, infos),
        chosen.get("world", "world"),
    )


def base(topic: str) -> str:
    """Topic without the part that names the transport."""
    head, _, last = topic.rpartition("/")
    return head if last in TRANSPORTS else topic


def _best(
    pairs: "list[tuple[Connection, Connection]]", images: "Sequence[Connection]", bag: str
) -> "tuple[Connection, Connection]":
    """The pair of one camera, rather registered than not, rectified than raw, and raw data than compressed."""

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
        raise DatasetError(f"{bag} holds depth but no colour images beside them: {_listed(images)}")
    if len(ranked) > 1 and score(ranked[0]) == score(ranked[1]):
        raise DatasetError(
            f"several topics of {bag} fit equally: {_listed(images)}; choose with --topics color=/...,depth=/..."
        )
    return ranked[0]


def _info_of(image: "Connection", infos: "Sequence[Connection]") -> "Connection | None":
    """The camera_info beside an image, as image_transport places it; RealSense's old files have it in ``info``."""
    parent = base(image.topic).rpartition("/")[0]
    names = (f"{parent}/camera_info", f"{parent.removesuffix('/image')}/info/camera_info")
    return next((info for name in names for info in infos if info.topic == name), None)


def _is_depth(connection: "Connection") -> bool:
    name = connection.topic.lower()
    return bool(DEPTH_NAME.search(name)) and not OTHER_NAME.search(name)


def _is_color(connection: "Connection") -> bool:
    name = connection.topic.lower()
    return bool(COLOR_NAME.search(name)) and not DEPTH_NAME.search(name) and not OTHER_NAME.search(name)


def _named(connections: "Sequence[Connection]", topic: str, bag: str) -> "Connection":
    for connection in connections:
        if connection.topic == topic:
            return connection
    raise DatasetError(f"there is no such topic {topic} in {bag}; it holds {_listed(connections)}")


def _listed(connections: "Iterable[Connection]") -> str:
    parts = [f"{connection.topic} ({connection.msgcount} {connection.msgtype})" for connection in connections]
    return ", ".join(parts) or "no topics of that type"
