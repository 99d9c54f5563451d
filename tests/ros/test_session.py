"""The ROS 2 package: what the node does with messages, on those of rosbags; rclpy is not needed."""

import ast
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from dudmap.config import Config
from dudmap.core.geometry.camera import Camera
from dudmap.core.places.saved_map import SavedMap
from dudmap.errors import ConfigError, DatasetError, MapError
from dudmap.io.exporting import ros_messages as ros
from dudmap.lab.synthetic import sequence
from off_course import LIMIT, off_course

PACKAGE = Path(__file__).parents[2] / "ros"
sys.path.insert(0, str(PACKAGE))
from dudmap_ros.session import Session, config_of, default_parameters

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = ros.MessageTypes(STORE.types.__getitem__)
K = np.array([140.0, 0, 79.5, 0, 140.0, 59.5, 0, 0, 1])
CAMERA = Camera(fx=140.0, fy=140.0, cx=79.5, cy=59.5, width=160, height=120)
COARSE = config_of({"volume.voxel_size": 0.04})


def messages(recording, index, offset=0.0):
    frame = recording[index]
    stamp = frame.timestamp + offset
    depth = np.rint(frame.depth * 1000).astype(np.uint16)
    info = TYPES.make(
        "sensor_msgs/msg/CameraInfo",
        header=ros.header(TYPES, stamp, "camera"), height=CAMERA.height, width=CAMERA.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=K, r=np.eye(3).reshape(-1),
        p=np.zeros(12), binning_x=0, binning_y=0, roi=None,
    )  # fmt: skip
    color = ros.image(TYPES, stamp, frame.color[..., ::-1], "bgr8", "camera")
    return ros.image(TYPES, stamp, depth, "16UC1", "camera"), color, info


@pytest.fixture(scope="module")
def recording():
    return sequence("room", (), frames=20, seed=3, camera=CAMERA)


def test_a_session_maps_saves_localizes_and_resets(recording, tmp_path):
    session = Session(COARSE)
    with pytest.raises(MapError, match="no map to save yet"):
        session.save(tmp_path / "run")
    with pytest.raises(MapError, match="no map to localise in"):
        session.set_localize(True)
    assert session.mesh() is None
    poses = [session.process(*messages(recording, index)).T_world_camera for index in range(12)]
    truth = recording.ground_truth.Ts_world_camera
    assert off_course(truth, poses) < LIMIT
    assert session.process(*messages(recording, 5)) is None
    assert (session.processed, session.stale) == (12, 1)
    folder = session.save(tmp_path / "run")
    assert len(SavedMap.load(folder, 0.04).keyframes) >= 1
    assert Config.load(folder / "config.toml").volume.voxel_size == 0.04
    session.set_localize(True)
    blocks = session.slam.volume.num_blocks
    assert not session.process(*messages(recording, 13)).fused
    assert session.slam.volume.num_blocks == blocks
    session.reset()
    assert session.mesh() is None
    assert not session.localize
    with pytest.raises(ConfigError, match="nothing to localise in; set the parameter saved_map"):
        Session(COARSE, localize=True)
    with pytest.raises(ConfigError, match="no earlier visit to compare with; set the parameter saved_map"):
        Session(COARSE, watch=True)

    later = Session(COARSE, saved_map=str(folder), localize=True)
    found = later.process(*messages(recording, 11, offset=50.0))
    assert "relocalized" in found.events
    assert off_course(truth[[0, 11]], [None, found.T_world_camera]) < LIMIT


def test_bad_messages_are_refused(recording):
    depth, color, info = messages(recording, 0)
    small = ros.image(TYPES, 0.0, np.zeros((60, 80, 3), np.uint8), "rgb8", "camera")
    with pytest.raises(DatasetError, match="depth is 160x120 and colour 80x60; subscribe to the depth that"):
        Session(COARSE).process(depth, small, info)
    info.k = np.zeros(9)
    with pytest.raises(DatasetError, match="has no focal length"):
        Session(COARSE).process(depth, color, info)


def test_parameters_are_the_configuration_keys():
    defaults = default_parameters()
    assert config_of(defaults) == Config()
    changed = config_of(defaults | {"tracker.huber": 0.02, "tracker.widths": [40, 80, 160]})
    assert (changed.tracker.huber, changed.tracker.widths) == (0.02, (40, 80, 160))
    assert config_of(defaults | {"system": "thesis"}) == Config.from_tree({"system": "thesis"})
    assert config_of(defaults, "near") == Config.for_range("near")
    assert config_of(defaults | {"volume.voxel_size": 0.02}, "far").volume.voxel_size == 0.02
    with pytest.raises(ConfigError, match="expected one of near, room, far"):
        config_of(defaults, "close")
    assert all(isinstance(value, bool | int | float | str | list) for value in defaults.values())


def imported(name):
    """Top-level packages that a module imports."""
    tree = ast.parse((PACKAGE / "dudmap_ros" / name).read_text(encoding="utf-8"))
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {name.partition(".")[0] for name in names}


def test_only_the_node_imports_ros_and_the_package_declares_it():
    assert imported("session.py") <= {"dudmap", "collections", "pathlib", "typing"}
    used = imported("node.py") - {"array", "importlib", "typing", "numpy", "dudmap", "dudmap_ros"}
    declared = {element.text for element in ElementTree.parse(PACKAGE / "package.xml").iter("exec_depend")}
    assert used <= declared


def test_the_image_is_made_of_what_the_lock_file_names():
    text = (PACKAGE / "Dockerfile").read_text(encoding="utf-8")
    assert "--require-hashes -r /dudmap/requirements/run.txt" in text
    assert "--no-index --no-build-isolation --no-deps /dudmap" in text
    assert "FROM ${BASE}" in text
