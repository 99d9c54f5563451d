"""The node where ROS is missing: imports, parameters, lifecycle, callbacks, on stand-ins of what ROS provides."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from dudmap.config import Config
from ros.test_session import STORE, messages, recording  # noqa: F401 - a fixture

SUCCESS, FAILURE = "success", "failure"


class StandIn:
    """What ``rclpy.lifecycle.LifecycleNode`` gives to a node: parameters, publishers, services, timers and a logger."""

    def __init__(self, name):
        self.name, self.parameters, self.published, self.alive, self.log = name, {}, {}, [], []

    def declare_parameter(self, name, value):
        assert isinstance(value, bool | int | float | str | list), name  # the types that ROS knows
        self.parameters[name] = value

    def get_parameter(self, name):
        return SimpleNamespace(value=self.parameters[name])

    def create_lifecycle_publisher(self, kind, topic, qos):
        sent = self.published.setdefault(topic.removeprefix("~/"), [])

        def publish(message):
            assert isinstance(message, kind)
            sent.append(message)

        return self.made(SimpleNamespace(publish=publish))

    def made(self, one):
        self.alive.append(one)
        return one

    def create_service(self, kind, name, callback):
        return self.made(SimpleNamespace(name=name, callback=callback))

    def create_timer(self, period, callback):
        return self.made(SimpleNamespace(callback=callback))

    def destroy(self, one):
        self.alive.remove(one)

    destroy_lifecycle_publisher = destroy_service = destroy_timer = destroy_subscription = destroy

    def get_logger(self):
        def say(text, **options):
            self.log.append(text)

        return SimpleNamespace(error=say, warning=say, info=say)

    def on_activate(self, state):
        return SUCCESS

    on_deactivate = on_activate


class Subscriber:
    def __init__(self, node, kind, topic, *, qos_profile):
        self.sub = node.made(SimpleNamespace(topic=topic))


class Synchronizer:
    def __init__(self, inputs, *, queue_size, slop):
        assert slop > 0

    def registerCallback(self, callback):
        self.callback = callback


class Broadcaster:
    def __init__(self, node):
        self.sent = []

    def sendTransform(self, message):
        self.sent.append(message)


def module(name, **content):
    made = ModuleType(name)
    vars(made).update(content)
    return made


@pytest.fixture
def node_class(monkeypatch):
    """``DudmapNode`` on stand-ins; messages are those of rosbags."""
    kinds = {}
    for name, kind in STORE.types.items():
        package, _, short = name.split("/")
        kinds.setdefault(package, {})[short] = kind
    modules = {f"{package}.msg": module(f"{package}.msg", **content) for package, content in kinds.items()}
    service = type("Service", (), {"Request": SimpleNamespace, "Response": SimpleNamespace})
    node = {"LifecycleNode": StandIn, "LifecycleState": object,
            "TransitionCallbackReturn": SimpleNamespace(SUCCESS=SUCCESS, FAILURE=FAILURE)}  # fmt: skip
    qos = {"DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1), "QoSProfile": SimpleNamespace,
           "qos_profile_sensor_data": None}  # fmt: skip
    modules |= {
        "rclpy": module("rclpy"), "rclpy.lifecycle": module("rclpy.lifecycle", **node),
        "rclpy.executors": module("rclpy.executors", ExternalShutdownException=type("Shutdown", (Exception,), {})),
        "rclpy.qos": module("rclpy.qos", **qos),
        "message_filters": module(
            "message_filters", Subscriber=Subscriber, ApproximateTimeSynchronizer=Synchronizer
        ),
        "std_srvs.srv": module("std_srvs.srv", SetBool=service, Trigger=service),
        "tf2_ros": module("tf2_ros", TransformBroadcaster=Broadcaster),
    }  # fmt: skip
    for name, one in modules.items():
        package = name.partition(".")[0]
        if package not in modules:
            monkeypatch.setitem(sys.modules, package, module(package))
        monkeypatch.setitem(sys.modules, name, one)
    monkeypatch.delitem(sys.modules, "dudmap_ros.node", raising=False)
    yield importlib.import_module("dudmap_ros.node").DudmapNode
    sys.modules.pop("dudmap_ros.node", None)


def answer():
    return SimpleNamespace(success=None, message=None)


def test_the_node_maps_publishes_saves_and_ends(node_class, recording, tmp_path):  # noqa: F811
    node = node_class()
    node.parameters |= {"volume.voxel_size": 0.04, "save_to": str(tmp_path / "run"), "mesh_triangles": 500}
    assert node.on_configure(None) == SUCCESS
    assert node.session.config.volume.voxel_size == 0.04
    refused = node.save(None, answer())
    assert (refused.success, refused.message) == (False, "there is no map to save yet")
    assert node.on_activate(None) == SUCCESS
    assert [one.sub.topic for one in node.inputs] == ["depth/image", "color/image", "color/camera_info"]
    node.publish_surface()
    assert node.published["mesh"] == []
    for index in range(8):
        depth, color, info = messages(recording, index)
        node.synchronizer.callback(depth, color, info)
    assert len(node.published["odometry"]) == len(node.broadcaster.sent) == len(node.published["mask"]) == 8
    assert node.published["odometry"][-1].child_frame_id == "camera"
    assert node.published["mask"][0].encoding == "mono8"
    assert all(frame.header.frame_id == "map" for frame in node.broadcaster.sent)
    node.timer.callback()
    assert len(node.published["path"][0].poses) == 8
    assert 0 < len(node.published["mesh"][0].points) <= 3 * 500
    assert node.published["points"][0].width > 1000
    assert node.save(None, answer()).message == f"saved to {(tmp_path / 'run').resolve()}"
    assert Config.load(tmp_path / "run/config.toml").volume.voxel_size == 0.04
    assert node.localize(SimpleNamespace(data=True), answer()).message == "localising, the map is kept"
    node.process(messages(recording, 9)[0], messages(recording, 9)[1], SimpleNamespace())  # the camera is known by now
    depth, color, info = messages(recording, 10)
    depth.encoding = "nonsense"
    node.process(depth, color, info)
    assert "nonsense" in node.log[-1]
    assert node.reset(None, answer()).message == "the map is empty"
    assert node.on_deactivate(None) == SUCCESS
    assert node.on_cleanup(None) == SUCCESS
    assert node.alive == []


def test_what_appeared_since_the_saved_map_is_published(node_class, recording, tmp_path):  # noqa: F811
    node = node_class()
    node.parameters |= {"volume.voxel_size": 0.04, "save_to": str(tmp_path / "run")}
    node.on_configure(None)
    node.on_activate(None)
    for index in range(20):
        node.process(*messages(recording, index))
    assert node.published["changes"] == []
    node.save(None, answer())
    node = node_class()
    node.parameters |= {"volume.voxel_size": 0.04, "saved_map": str(tmp_path / "run"), "watch": True, "localize": True}
    node.on_configure(None)
    node.on_activate(None)
    for index in range(20):
        depth, color, info = messages(recording, index, offset=50 + 0.1 * index)
        if index > 2:
            z = depth.data.view(np.uint16).reshape(depth.height, depth.width).copy()
            z[45:80, 60:95] = 2000  # a plate in the air
            depth.data = z.view(np.uint8).reshape(-1)
        node.process(depth, color, info)
    shown = [len(message.markers) - 1 for message in node.published["changes"]]  # the first marker removes old ones
    assert shown == [1]


def test_a_node_that_is_stopped_saves_what_was_not_saved(node_class, recording, tmp_path, monkeypatch):  # noqa: F811
    """rclpy ends ``spin`` by an exception of its own when SIGTERM comes, or SIGINT of a launch."""
    nodes = sys.modules[node_class.__module__]
    made = []

    def spin(node):
        made.append(node)
        node.process(*messages(recording, 0))
        raise nodes.ExternalShutdownException

    monkeypatch.setattr(nodes, "DudmapNode", lambda: prepared(node_class, tmp_path / "run"))
    for name in ("init", "try_shutdown"):
        monkeypatch.setattr(nodes.rclpy, name, lambda **_: None, raising=False)
    monkeypatch.setattr(nodes.rclpy, "spin", spin, raising=False)
    nodes.main()
    assert (tmp_path / "run" / "map.npz").is_file()
    nodes.main()  # of the next start in this folder, which keeps the run before
    assert (tmp_path / "run-2" / "mesh.ply").is_file()
    assert "run-2" in made[-1].log[-1]
    made[-1].session.save(tmp_path / "run-2")
    made[-1].end()
    assert not (tmp_path / "run-3").exists()


def prepared(node_class, folder):
    node = node_class()
    node.parameters |= {"volume.voxel_size": 0.04, "save_to": str(folder)}
    node.trigger_configure = lambda: node.on_configure(None)
    node.trigger_activate = lambda: node.on_activate(None)
    node.destroy_node = lambda: None
    return node


def test_a_wrong_parameter_is_said_and_refused(node_class):
    node = node_class()
    node.parameters["volume.voxel_size"] = -1.0
    assert node.on_configure(None) == FAILURE
    assert "voxel_size" in node.log[-1]
    node = node_class()
    node.parameters["localize"] = True
    assert node.on_configure(None) == FAILURE
    assert "nothing to localise in" in node.log[-1]


def test_a_lost_frame_is_a_warning(node_class, recording):  # noqa: F811
    node = node_class()
    node.parameters["volume.voxel_size"] = 0.04
    node.on_configure(None)
    node.on_activate(None)
    for index in range(3):
        depth, color, info = messages(recording, index)
        if index == 2:
            depth.data = np.zeros_like(depth.data)
        node.process(depth, color, info)
    assert node.log[-1].startswith("lost: ")
    assert len(node.published["odometry"]) == 2
