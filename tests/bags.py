"""Writer of tiny bags with the writers of the package rosbags, independent of the reader."""

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from recordings import HEIGHT, WIDTH, color_image, depth_image

K = [60.0, 0, 31.5, 0, 61.0, 23.5, 0, 0, 1]
START = 1_600_000_000
"""Second at which the bags start."""


class BagWriter:
    """A bag of one kind: ``ros1``, ``sqlite`` or ``mcap``."""

    def __init__(self, path, kind, **options):
        self.ros1, self.path = kind == "ros1", path
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        tf = "tf2_msgs/msg/TFMessage"
        if self.ros1:
            self.store.register({tf: get_typestore(Stores.ROS2_HUMBLE).fielddefs[tf]})
        plugin = {"sqlite": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
        self.writer = Writer1(path) if self.ros1 else Writer2(path, version=8, storage_plugin=plugin[kind])
        for name, value in options.items():
            getattr(self.writer, name)(*value)
        self.writer.open()
        self.connections = {}

    def type(self, name):
        return self.store.types[name]

    def header(self, stamp, frame):
        seconds = int(np.floor(stamp))
        time = self.type("builtin_interfaces/msg/Time")(seconds, round((stamp - seconds) * 1e9))
        header = self.type("std_msgs/msg/Header")
        return header(seq=0, stamp=time, frame_id=frame) if self.ros1 else header(stamp=time, frame_id=frame)

    def write(self, topic, message, recorded):
        """Write a message at a time of recording in seconds."""
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(recorded * 1e9), serialize(message, kind))

    def image(self, pixels, encoding, stamp, frame, padding=0):
        rows = pixels.reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        return self.type("sensor_msgs/msg/Image")(
            self.header(stamp, frame), pixels.shape[0], pixels.shape[1], encoding, 0, rows.shape[1], rows.reshape(-1)
        )

    def compressed(self, data, form, stamp, frame):
        data = np.frombuffer(data, np.uint8)
        return self.type("sensor_msgs/msg/CompressedImage")(self.header(stamp, frame), form, data)

    def info(self, stamp, frame, k=K, d=(0.0,) * 5, model="plumb_bob", size=(WIDTH, HEIGHT), p=None):
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        p = np.array([*k[:3], 0, *k[3:6], 0, *k[6:9], 0] if p is None else p, float)
        arrays = np.array(d, float), np.array(k, float), np.eye(3).reshape(-1), p
        return self.type("sensor_msgs/msg/CameraInfo")(
            self.header(stamp, frame), size[1], size[0], model, *arrays, 0, 0, roi
        )

    def transform(self, stamp, parent, child, t=(0, 0, 0), q=(0, 0, 0, 1)):
        vector, quaternion = self.type("geometry_msgs/msg/Vector3"), self.type("geometry_msgs/msg/Quaternion")
        motion = self.type("geometry_msgs/msg/Transform")(vector(*map(float, t)), quaternion(*map(float, q)))
        stamped = self.type("geometry_msgs/msg/TransformStamped")(self.header(stamp, parent), child, motion)
        return self.type("tf2_msgs/msg/TFMessage")([stamped])

    def imu(self, stamp, frame, acceleration):
        vector, none = self.type("geometry_msgs/msg/Vector3"), np.zeros(9)
        turn = self.type("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
        parts = turn, none, vector(0.0, 0.0, 0.0), none, vector(*map(float, acceleration)), none
        return self.type("sensor_msgs/msg/Imu")(self.header(stamp, frame), *parts)

    def close(self):
        self.writer.close()


def millimetres(index):
    """Depth image (H, W) uint16 of a frame."""
    return depth_image(index) // 5


def write_bag(path, kind, frames=5, **options):
    """Bag of registered frames; the options of ``write_frames``, and of the writer."""
    names = write_frames.__kwdefaults__
    bag = BagWriter(path, kind, **{name: value for name, value in options.items() if name not in names})
    write_frames(bag, frames, **{name: value for name, value in options.items() if name in names})
    return path


def write_frames(bag, frames, *, color_frame="rgb", depth_frame="rgb", delay=0.01, depth_topic=None):
    """Registered frames at 10 Hz; colour is 4 ms later and everything is recorded ``delay`` seconds late."""
    depth_topic = depth_topic or "/camera/aligned_depth_to_color/image_raw"
    infos = {"/camera/color/camera_info": color_frame, f"{depth_topic.rpartition('/')[0]}/camera_info": depth_frame}
    for index in range(frames):
        stamp = START + 0.1 * index
        for topic, frame in infos.items():
            bag.write(topic, bag.info(stamp, frame), stamp + delay)
        bag.write(depth_topic, bag.image(millimetres(index), "16UC1", stamp, depth_frame), stamp + delay)
        color = bag.image(color_image(index), "rgb8", stamp + 0.004, color_frame)
        bag.write("/camera/color/image_raw", color, stamp + 0.004 + delay)
    bag.close()
