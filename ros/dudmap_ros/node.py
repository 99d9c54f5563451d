"""Lifecycle node: colour, depth and camera_info in; tf, odometry, path, surface, mask and movers out."""

import array
from importlib import import_module
from typing import Any

import numpy as np
import rclpy
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import SetBool, Trigger
from tf2_ros import TransformBroadcaster
from visualization_msgs.msg import Marker, MarkerArray

from dudmap.core.geometry.mesh_simplification import simplified
from dudmap.errors import DudmapError
from dudmap.io.exporting import ros_messages as ros
from dudmap_ros.session import Session, config_of, default_parameters

SETTINGS = {
    "map_frame": "map",
    "camera_frame": "",
    "range": "room",
    "saved_map": "",
    "localize": False,
    "watch": False,
    "ignore": "",
    "save_to": "dudmap_run",
    "surface_period": 5.0,
    "mesh_triangles": 50_000,
    "sync_slop": 0.02,
    "autostart": True,
}
"""Parameters of the node; all others are keys of the configuration. docs/robot.md describes them."""


def message_type(name: str) -> Any:  # noqa: ANN401
    """Class of a message type such as ``nav_msgs/msg/Path``."""
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


TYPES = ros.MessageTypes(message_type, lambda values: array.array("B", np.ascontiguousarray(values).tobytes()))


class DudmapNode(LifecycleNode):
    """Maps while it is active; the map is kept when it is deactivated and dropped when it is cleaned up."""

    def __init__(self) -> None:
        super().__init__("dudmap")
        self.keys = default_parameters()
        for name, value in (SETTINGS | self.keys).items():
            self.declare_parameter(name, value)
        self.session: Session | None = None
        self.shown: list[dict] = []
        self.inputs: list[Subscriber] = []

    def setting(self, name: str) -> Any:  # noqa: ANN401
        """Value of a parameter."""
        return self.get_parameter(name).value

    # -- lifecycle -----------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, create publishers and services."""
        try:
            config = config_of({key: self.setting(key) for key in self.keys}, self.setting("range"))
            self.session = Session(
                config, self.setting("saved_map") or None, self.setting("localize"), self.setting("watch"),
                self.setting("ignore") or None,
            )  # fmt: skip
        except DudmapError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self.shown = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.outputs = {
            "odometry": self.create_lifecycle_publisher(Odometry, "~/odometry", 10),
            "mask": self.create_lifecycle_publisher(Image, "~/mask", 2),
            "movers": self.create_lifecycle_publisher(MarkerArray, "~/movers", 10),
            "changes": self.create_lifecycle_publisher(MarkerArray, "~/changes", latched),
            "path": self.create_lifecycle_publisher(Path, "~/path", latched),
            "points": self.create_lifecycle_publisher(PointCloud2, "~/points", latched),
            "mesh": self.create_lifecycle_publisher(Marker, "~/mesh", latched),
        }
        self.broadcaster = TransformBroadcaster(self)
        self.offered = [
            self.create_service(Trigger, "~/save", self.save),
            self.create_service(Trigger, "~/reset", self.reset),
            self.create_service(SetBool, "~/localize", self.localize),
        ]
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to the camera."""
        topics = ((Image, "depth/image"), (Image, "color/image"), (CameraInfo, "color/camera_info"))
        self.inputs = [Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data) for kind, topic in topics]
        self.synchronizer = ApproximateTimeSynchronizer(self.inputs, queue_size=5, slop=self.setting("sync_slop"))
        self.synchronizer.registerCallback(self.process)
        period = self.setting("surface_period")
        self.timer = self.create_timer(period, self.publish_surface) if period > 0 else None
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; the map is kept."""
        for subscriber in self.inputs:
            self.destroy_subscription(subscriber.sub)
        self.inputs = []
        if self.timer is not None:
            self.destroy_timer(self.timer)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop the map, publishers and services."""
        for publisher in self.outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        for service in self.offered:
            self.destroy_service(service)
        self.session = None
        return TransitionCallbackReturn.SUCCESS

    # -- data ----------------------------------------------------------------------------------------------------------

    def process(self, depth: Image, color: Image, info: CameraInfo) -> None:
        """Process a synchronised set of messages and publish the results."""
        assert self.session is not None
        try:
            result = self.session.process(depth, color, info)
        except DudmapError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        if result is None:
            return
        frame, map_frame = self.setting("camera_frame") or depth.header.frame_id, self.setting("map_frame")
        mask = np.where(result.dynamic_mask, np.uint8(255), np.uint8(0))
        stamp = result.timestamp
        self.outputs["mask"].publish(ros.image(TYPES, stamp, mask, "mono8", frame))
        if result.T_world_camera is None:
            self.get_logger().warning(f"lost: {result.verdict.reason}", throttle_duration_sec=1.0)
            return
        T, velocity = result.T_world_camera, self.session.slam.motion.velocity
        self.broadcaster.sendTransform(ros.transform(TYPES, stamp, T, map_frame, frame))
        self.outputs["odometry"].publish(ros.odometry(TYPES, stamp, T, result.covariance, velocity, map_frame, frame))
        movers = [{"id": mover.id, "box": mover.box} for mover in result.movers]
        self.outputs["movers"].publish(ros.mover_markers(TYPES, stamp, movers, map_frame))
        changes = self.session.watch.reported if self.session.watch is not None else []
        if changes != self.shown:
            self.shown = list(changes)
            self.outputs["changes"].publish(ros.mover_markers(TYPES, stamp, changes, map_frame))

    def publish_surface(self) -> None:
        """Publish path, points and mesh of the map so far."""
        mesh = self.session.mesh() if self.session is not None else None
        if mesh is None:
            return
        map_frame, trajectory = self.setting("map_frame"), self.session.slam.maps[0][0]
        if len(trajectory) == 0:
            return
        stamp = float(trajectory.timestamps[-1])
        poses = trajectory.timestamps, trajectory.Ts_world_camera
        self.outputs["path"].publish(ros.path(TYPES, stamp, *poses, map_frame))
        self.outputs["points"].publish(ros.cloud(TYPES, stamp, mesh.vertices, mesh.colors, map_frame))
        coarse = simplified(mesh, self.setting("mesh_triangles"))
        self.outputs["mesh"].publish(ros.mesh_marker(TYPES, stamp, coarse, map_frame))

    # -- services ------------------------------------------------------------------------------------------------------

    def save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Write the map as a run folder (parameter ``save_to``)."""
        return self.answer(response, lambda: f"saved to {self.session.save(self.setting('save_to')).resolve()}")

    def reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start a new map with the next images."""
        self.shown = []
        return self.answer(response, lambda: self.session.reset() or "the map is empty")

    def localize(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Stop changing the map (true) or continue mapping (false)."""
        mode = "localising, the map is kept" if request.data else "mapping"
        return self.answer(response, lambda: self.session.set_localize(request.data) or mode)

    def end(self) -> None:
        """Save an unsaved map when the node is stopped; an existing run folder is kept."""
        try:
            folder = self.session.save_rest(self.setting("save_to")) if self.session is not None else None
            if folder is not None:
                self.get_logger().info(f"saved to {folder.resolve()}")
        except DudmapError as error:
            self.get_logger().error(str(error))

    def answer(self, response: Any, act: Any) -> Any:  # noqa: ANN401
        """Fill a response with the result text of an action, or with its error."""
        try:
            response.success, response.message = True, act()
        except DudmapError as error:
            response.success, response.message = False, str(error)
        return response


def main(args: list[str] | None = None) -> None:
    """Run the node until it is stopped."""
    rclpy.init(args=args)
    node = DudmapNode()
    if node.setting("autostart"):
        node.trigger_configure()
        node.trigger_activate()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.end()
        node.destroy_node()
        rclpy.try_shutdown()
