"""Recordings of RealSense cameras: ``.db3`` files of librealsense since March 2026, ``.bag`` files of earlier ones.

Both are ROS bags with topics of their own; the package rosbags reads them without the driver, with random access,
which the driver's playback does not offer.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.geometry import se3
from dudmap.core.geometry.camera import Camera
from dudmap.input_files import open_plain
from dudmap.io.sequences.bag import MAGIC, MILLIMETRES, RosBag
from dudmap.io.sequences.bag_file import MessageTimes
from dudmap.io.sequences.bag_transforms import motion_of
from dudmap.io.sequences.lens import Lens

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

TOPICS = b"/device_0/sensor_"
"""Start of the topics of the first camera's streams."""
HEAD = 1 << 18
"""Bytes at the start of a file among which the topics are looked for."""


class RealSenseRecording(RosBag):
    """Recording of a RealSense camera; depth is registered by the factory calibration in the file.

    The frames' times are those of the camera: in the metadata of every frame (``.db3``, whose headers hold the times of
    recording) or in the headers (``.bag``). The depth unit is the camera's option of that name.
    """

    format = "RealSense recording"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a .bag or .db3 file has the topics of librealsense."""
        if path.suffix.lower() not in (".bag", ".db3") or not path.is_file():
            return False
        with open_plain(path, pointers=True) as file:
            head = file.read(HEAD)
        return head.startswith(MAGIC[path.suffix.lower()]) and TOPICS in head

    def _times(self, connection: "Connection") -> MessageTimes:
        found = super()._times(connection)
        metadata = self._beside(connection, "image/metadata", "std_msgs/msg/String")
        if metadata is None:
            return found
        stamps = {}
        for time, message in self._bag.messages([metadata]):
            if match := re.search(r"(?:^|;)timestamp=([\d.]+)", message.data):
                stamps[time] = 1e-3 * float(match[1])
        kept = np.array([int(time) in stamps for time in found.recorded])
        if not kept.any():
            return found
        recorded = found.recorded[kept]
        return MessageTimes(recorded, np.array([stamps[int(time)] for time in recorded]), True)

    def _T_color_depth(self, color_frame: str) -> NDArray[np.float64] | None:
        """Motion through the reference of both streams, whose points the file takes to either stream."""
        motions = [self._motion(connection) for connection in (self._topics.color, self._topics.depth)]
        if motions[0] is None or motions[1] is None:
            return None
        return motions[0] @ se3.inverse(motions[1])

    def _lens(self, connection: "Connection | None", image: "Connection", shape: tuple[int, int]) -> Lens | None:
        """Lens of a stream; the camera_info of .db3 files calls every model plumb_bob, the text beside it does not."""
        text = self._beside(image, "camera_info", "std_msgs/msg/String")
        model = re.search(r"model=([^;]*)", self._bag.first(text).data) if text else None
        self._model = model[1] if model else ""
        return super()._lens(connection, image, shape)

    def _lens_of(self, camera: Camera, model: str, coefficients: tuple[float, ...]) -> Lens:
        return Lens.of(camera, self._model or model, coefficients)

    def _units(self) -> float:
        sensor = re.match(r"/device_\d+/sensor_\d+", self._topics.depth.topic)
        topic = f"{sensor[0]}/option/Depth_Units/value" if sensor else ""
        for connection in self._bag.connections:
            if connection.topic == topic and connection.msgcount:
                unit = float(self._bag.first(connection).data)
                return round(1 / unit, 2) if unit > 0 else MILLIMETRES  # the option is a float32
        return MILLIMETRES

    def _motion(self, image: "Connection") -> NDArray[np.float64] | None:
        """Motion (4, 4) of points of the reference into a stream, from its topic ``tf/...``."""
        found = self._beside(image, "tf/", "")
        return None if found is None else _motion(self._bag.first(found))

    def _beside(self, image: "Connection", name: str, msgtype: str) -> "Connection | None":
        """First topic of the same stream whose name goes on with ``name``."""
        stream = re.match(r"/device_\d+/sensor_\d+/\w+", image.topic)
        prefix = f"{stream[0] if stream else image.topic}/{name}"
        for connection in self._bag.connections:
            right = connection.topic.startswith(prefix) and connection.msgtype.startswith(msgtype)
            if right and connection.msgcount:
                return connection
        return None


def _motion(message: Any) -> NDArray[np.float64]:  # noqa: ANN401 - the type is made from the bag
    """Motion of a geometry_msgs/Transform, or of text with the rotation column by column."""
    if not hasattr(message, "data"):
        return motion_of(message)
    T = np.eye(4)
    numbers = [float(number) for number in re.findall(r"[-+\d.eE]*\d[\d.]*", message.data)]
    T[:3, :3] = se3.nearest_rotation(np.array(numbers[:9]).reshape(3, 3).T)
    T[:3, 3] = numbers[9:12]
    return T
