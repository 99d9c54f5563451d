"""ROS 1 bags, ROS 2 bags (folders, SQLite and MCAP files), and RealSense recordings (``.db3`` since March 2026,
``.bag`` before), through rosbags."""

import re
import weakref
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dudmap.core.frames.frame import Frame
from dudmap.core.geometry import se3
from dudmap.core.geometry.association import LARGEST_GAP, associate
from dudmap.core.geometry.calibration import Calibration
from dudmap.core.geometry.camera import Camera
from dudmap.core.geometry.trajectory import Trajectory
from dudmap.errors import DatasetError, FrameError
from dudmap.input_files import GIT_LFS, foreign, open_plain
from dudmap.io.exporting.ros_messages import seconds_of
from dudmap.io.sequences import Recording, bag_messages, intrinsics
from dudmap.io.sequences.bag_file import BagFile, MessageTimes
from dudmap.io.sequences.bag_imu import gravity_of, is_realsense_optical
from dudmap.io.sequences.bag_messages import STATIC_TOPIC, TOPIC, TransformTree, motion_of
from dudmap.io.sequences.gravity import Gravity
from dudmap.io.sequences.image_folder import PROBES, size
from dudmap.io.sequences.intrinsics import Lens

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

MAGIC = {".bag": b"#ROSBAG V2.0", ".active": b"#ROSBAG V2.0", ".db3": b"SQLite format 3", ".mcap": b"\x89MCAP0\r\n"}
MILLIMETRES = 1000.0
"""Units per metre of 16-bit depth images (ROS REP 118)."""
FIRST_TRANSFORMS = 300
"""First /tf messages that list the frames."""


class RosBag(Recording):
    """Recording in a ROS bag; images and poses are read when used.

    * Times are stamps of the depth messages; in compressed bags, recording times minus the median delay; if stamps do
      not increase, recording times.
    * Colour pairs one to one, nearest first, at most 20 ms apart; duplicates in time are skipped.
    * Intrinsics come from camera_info. Depth and colour are registered if frame of reference and intrinsics are equal;
      else ``calibration`` has the colour camera, its motion from /tf_static. Rational and fisheye lenses are rectified.
    * The ground truth is the depth camera's trajectory in the frame ``world`` of /tf.

    Args:
        path: A .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.
        camera: Intrinsics that replace the bag's.
        topics: ``color=/a,depth=/b,color_info=/c,depth_info=/d,world=map``, each optional.
    """

    format = "ROS bag"
    options: tuple[str, ...] = ("topics", "depth_unit")
    timed = True

    def __init__(self, path: str | Path, camera: Camera | str | None = None, topics: str | None = None) -> None:
        super().__init__(path)
        chosen = bag_messages.chosen_topics(topics)
        self._bag = BagFile(self.path)
        weakref.finalize(self, self._bag.close)
        with foreign(DatasetError, f"the bag {self.path}"):
            self._find_frames(chosen, camera)

    def _find_frames(self, chosen: dict[str, str], camera: Camera | str | None) -> None:
        self._topics = bag_messages.find_topics(self._bag.connections, chosen, str(self.path), self._bag.first)
        self.has_color = self._topics.color is not self._topics.depth
        depth, color = self._times(self._topics.depth), self._times(self._topics.color)
        self._exact = depth.exact and color.exact
        self._pairs = self._associated(depth, color)
        self.timestamps = depth.stamps[[k for _, k in self._pairs]]
        self._color_stamps = color.stamps[[k for k, _ in self._pairs]]
        self._recorded = [(int(color.recorded[i]), int(depth.recorded[j])) for i, j in self._pairs]
        self._find_cameras(camera)
        if self._bag.unclosed:
            self.remarks = [
                f"{self.path} was not closed by its recorder, or is cut off: {len(self)} frames are found, up to "
                f"{self.timestamps[-1] - self.timestamps[0]:.1f} s after the first one"
            ]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file starts like a bag, or a folder holds metadata.yaml."""
        if path.is_dir():
            return (path / "metadata.yaml").is_file()
        magic = MAGIC.get(path.suffix.lower())
        if magic is None or not path.is_file():
            return False
        with open_plain(path, pointers=True) as file:  # Git LFS may have to fetch it
            return file.read(max(len(magic), len(GIT_LFS))).startswith((magic, GIT_LFS))

    def _frame(self, index: int, name: str) -> Frame:
        depth, values, color, image = self._decoded(index, self.camera.depth_scale)
        expected = self.camera if self.calibration is None else self.calibration.camera
        for what, found, camera in (("colour", image, expected), ("depth", values, self.camera)):
            if found.shape[:2] != camera.shape:
                raise FrameError(
                    f"{name}: the {what} image is {size(found)} pixels, but its camera is "
                    f"{camera.width}x{camera.height}"
                )
        values, image = self._depth_lens.rectify(values, depth=True), self._color_lens.rectify(image, depth=False)
        if not self.has_color:
            return Frame(float(self.timestamps[index]) if self._exact else seconds_of(depth), values)
        if self._exact:
            return Frame(float(self.timestamps[index]), values, image, float(self._color_stamps[index]))
        return Frame(seconds_of(depth), values, image, seconds_of(color))

    def _decoded(self, index: int, depth_scale: float) -> tuple[Any, NDArray[np.float32], Any, NDArray[np.uint8]]:
        topics, (color_time, depth_time), name = self._topics, self._recorded[index], f"frame {index} of {self.path}"
        with foreign(FrameError, name):
            wanted = [(topics.color, color_time)] if self.has_color else []
            *colors, depth = self._bag.read([*wanted, (topics.depth, depth_time)])
            values = bag_messages.depth_of(depth, depth_scale, f"the depth image of {name}")
            if not colors:
                return depth, values, depth, Frame(0.0, values).rgb
            return depth, values, colors[0], bag_messages.color_of(colors[0], f"the colour image of {name}")

    @cached_property
    def ground_truth(self) -> Trajectory | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True poses of the depth camera, None without a world frame."""
        with foreign(DatasetError, f"the poses in /tf of {self.path}"):
            return self._true_poses()

    @cached_property
    def gravity(self) -> Gravity | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Gravity measured by the IMU, or None."""
        with foreign(DatasetError, f"the accelerations in {self.path}"):
            return gravity_of(self._bag, self._rotation_of)

    def _rotation_of(self, imu: str) -> NDArray[np.float64] | None:
        T = self._transforms.between(self._depth_frame, imu)
        if T is None:
            return np.eye(3) if is_realsense_optical(imu, self._depth_frame) else None
        return T[:3, :3]

    def _true_poses(self) -> Trajectory | None:
        world, frame = self._topics.world, self._depth_frame
        if not self._transforms.reaches(world, frame):
            return None
        return self._tree(None).trajectory(world, frame, self.timestamps)

    def _times(self, connection: "Connection") -> MessageTimes:
        found = self._bag.times(connection)
        if np.mean(np.diff(found.stamps, prepend=-np.inf) > 0) < 0.9:  # a driver that does not fill the headers
            return found._replace(stamps=1e-9 * found.recorded, exact=True)
        return found

    def _associated(self, depth: MessageTimes, color: MessageTimes) -> list[tuple[int, int]]:
        colors, color_order = np.unique(color.stamps, return_index=True)
        depths, depth_order = np.unique(depth.stamps, return_index=True)
        pairs = [(int(color_order[i]), int(depth_order[j])) for i, j in associate(colors, depths)]
        if not pairs:
            raise DatasetError(
                f"{self.path}: no image of {self._topics.color.topic} lies within {1000 * LARGEST_GAP:.0f} ms of one "
                f"of {self._topics.depth.topic}; they cover {colors[0]:.3f} to {colors[-1]:.3f} s and "
                f"{depths[0]:.3f} to {depths[-1]:.3f} s"
            )
        return pairs

    def _find_cameras(self, given: Camera | str | None) -> None:
        topics = self._topics
        depth, values, color, image = self._probe()
        depth_size, color_size = values.shape[::-1], image.shape[1::-1]
        self._depth_frame = depth.header.frame_id
        self._uncalibrated: list[str] = []
        color_lens = self._lens(topics.color_info, topics.color, color_size)
        one_size = depth_size == color_size
        if given is not None:
            known = intrinsics.given(given)
            depth_lens = Lens(known.camera(depth_size[0], depth_size[1], self._units()))
            source = known.source
        else:
            info, image_topic = topics.depth_info, topics.depth
            if info is None and one_size and topics.registered:
                info, image_topic = topics.color_info, topics.color
            depth_lens = self._lens(info, image_topic, depth_size)
            source = info.topic if info else ""
        if depth_lens is None:
            raise DatasetError(
                f"{self.path} holds no camera_info for {topics.depth.topic}{self._without()}; choose it with "
                "--topics depth_info=/..., or give --camera fx,fy,cx,cy[,w,h[,depth_scale]]"
            )
        if color_lens is None and not one_size:
            raise DatasetError(
                f"{self.path}: depth is {size(values)} and colour {size(image)} pixels, and there is no camera_info "
                f"for {topics.color.topic}{self._without()}; choose it with --topics color_info=/..."
            )
        if color_lens is None or (given is not None and one_size):
            color_lens = depth_lens
        self.sources = {
            "intrinsics": source,
            "depth unit": "the bag, or millimetres as ROS has them",
            "times": "the bag",
        }
        self.camera, self._depth_lens, self._color_lens = depth_lens.camera, depth_lens, color_lens
        together = color_lens is depth_lens
        self.calibration = None if together else self._between(depth_lens, color_lens, color.header.frame_id)

    def _probe(self) -> tuple[Any, NDArray[np.float32], Any, NDArray[np.uint8]]:
        problem = None
        for index in np.unique(np.linspace(0, len(self) - 1, PROBES).astype(int)):
            try:
                return self._decoded(int(index), 1.0)
            except FrameError as error:
                problem = problem or error
        raise DatasetError(f"no frame of {self.path} is usable; {problem}")

    def _between(self, depth: Lens, color: Lens, color_frame: str) -> Calibration | None:
        same_frame = color_frame.lstrip("/") == self._depth_frame.lstrip("/") or self._topics.registered
        T = np.eye(4) if same_frame else self._T_color_depth(color_frame)
        if T is None:
            raise DatasetError(
                f"{self.path}: depth is seen from {self._depth_frame!r} and colour from {color_frame!r}, and "
                "/tf_static holds no transform between them; choose registered depth with --topics depth=/..., or, if "
                "it is registered, give its intrinsics with --camera"
            )
        if same_frame and _equal(depth, color):
            return None
        calibration = Calibration(color.camera, T)
        return None if calibration.is_registered(depth.camera) else calibration

    def _T_color_depth(self, color_frame: str) -> NDArray[np.float64] | None:
        return self._transforms.between(color_frame, self._depth_frame)

    def _units(self) -> float:
        return MILLIMETRES

    def _lens(self, connection: "Connection | None", image: "Connection", shape: tuple[int, int]) -> Lens | None:
        info = self._bag.first(connection)
        if info is None:
            return None
        K, P, D = (getattr(info, name if hasattr(info, name) else name.upper()) for name in "kpd")
        if not K[0] > 0 and connection is not None:  # drivers write this for a camera that is not calibrated
            self._uncalibrated.append(connection.topic)
            return None
        rectified = "rect" in bag_messages.base(image.topic).rpartition("/")[2] and P[0] > 0
        fx, cx, fy, cy = (P[0], P[2], P[5], P[6]) if rectified else (K[0], K[2], K[4], K[5])
        width, height = (info.width, info.height) if info.width and info.height else shape
        units = self._units()
        camera = Camera(float(fx), float(fy), float(cx), float(cy), int(width), int(height), units).resized(*shape)
        return Lens(camera) if rectified else Lens.of(camera, self._model_of(image, info), tuple(map(float, D)))

    def _without(self) -> str:
        found = " and ".join(dict.fromkeys(self._uncalibrated))
        return f" with a focal length (K in {found} is all zeros: that camera is not calibrated)" if found else ""

    def _model_of(self, image: "Connection", info: Any) -> str:  # noqa: ANN401
        return info.distortion_model

    @cached_property
    def _transforms(self) -> TransformTree:
        return self._tree(FIRST_TRANSFORMS)

    def _tree(self, count: int | None) -> TransformTree:
        tree = TransformTree()
        for topic, limit in ((TOPIC, count), (STATIC_TOPIC, FIRST_TRANSFORMS)):
            found = [c for c in self._bag.connections if c.topic == topic and c.msgcount]
            if found:
                messages = (message for _, message in self._bag.messages(found, limit))
                tree.add(messages, static=topic == STATIC_TOPIC)
        return tree


def _equal(one: Lens, other: Lens) -> bool:
    a, b = one.camera, other.camera
    numbers = [(c.fx, c.fy, c.cx, c.cy, *(c.distortion or (0.0,) * 5)) for c in (a, b)]
    alike = len(numbers[0]) == len(numbers[1]) and np.allclose(*numbers, rtol=0, atol=1e-3)
    return a.shape == b.shape and alike and one.model == other.model


TOPICS = b"/device_0/sensor_"
HEAD = 1 << 18


class RealSenseRecording(RosBag):
    """RealSense recording; depth is registered by the factory calibration in the file.

    Frame times come from metadata (``.db3``) or headers (``.bag``), the depth unit from the camera's option.
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

    def _rotation_of(self, imu: str) -> NDArray[np.float64] | None:
        return np.eye(3)

    def _T_color_depth(self, color_frame: str) -> NDArray[np.float64] | None:
        motions = [self._motion(connection) for connection in (self._topics.color, self._topics.depth)]
        if motions[0] is None or motions[1] is None:
            return None
        return motions[0] @ se3.inverse(motions[1])

    def _model_of(self, image: "Connection", info: Any) -> str:  # noqa: ANN401
        text = self._beside(image, "camera_info", "std_msgs/msg/String")
        found = re.search(r"model=([^;]+)", self._bag.first(text).data) if text else None
        return found[1] if found else info.distortion_model

    def _units(self) -> float:
        sensor = re.match(r"/device_\d+/sensor_\d+", self._topics.depth.topic)
        topic = f"{sensor[0]}/option/Depth_Units/value" if sensor else ""
        for connection in self._bag.connections:
            if connection.topic == topic and connection.msgcount:
                unit = float(self._bag.first(connection).data)
                return round(1 / unit, 2) if unit > 0 else MILLIMETRES  # the option is a float32
        return MILLIMETRES

    def _motion(self, image: "Connection") -> NDArray[np.float64] | None:
        found = self._beside(image, "tf/", "")
        return None if found is None else _motion(self._bag.first(found))

    def _beside(self, image: "Connection", name: str, msgtype: str) -> "Connection | None":
        stream = re.match(r"/device_\d+/sensor_\d+/\w+", image.topic)
        prefix = f"{stream[0] if stream else image.topic}/{name}"
        for connection in self._bag.connections:
            right = connection.topic.startswith(prefix) and connection.msgtype.startswith(msgtype)
            if right and connection.msgcount:
                return connection
        return None


def _motion(message: Any) -> NDArray[np.float64]:  # noqa: ANN401 - the type is made from the bag
    if not hasattr(message, "data"):
        return motion_of(message)
    T = np.eye(4)
    numbers = [float(number) for number in re.findall(r"[-+\d.eE]*\d[\d.]*", message.data)]
    T[:3, :3] = se3.nearest_rotation(np.array(numbers[:9]).reshape(3, 3).T)
    T[:3, 3] = numbers[9:12]
    return T
