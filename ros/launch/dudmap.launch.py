"""Start the node with a parameter file; arguments name the camera topics. Defaults: the topics of realsense2."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

TOPICS = {
    "color": "/camera/camera/color/image_raw",
    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    "camera_info": "/camera/camera/color/camera_info",
}


def generate_launch_description() -> LaunchDescription:
    """The node and its arguments."""
    config = str(Path(get_package_share_directory("dudmap_ros")) / "config" / "dudmap.yaml")
    arguments = [DeclareLaunchArgument(name, default_value=topic) for name, topic in TOPICS.items()]
    arguments.append(DeclareLaunchArgument("config", default_value=config))
    node = LifecycleNode(
        package="dudmap_ros",
        executable="dudmap_node",
        name="dudmap",
        namespace="",
        output="screen",
        parameters=[LaunchConfiguration("config")],
        remappings=[
            ("color/image", LaunchConfiguration("color")),
            ("depth/image", LaunchConfiguration("depth")),
            ("color/camera_info", LaunchConfiguration("camera_info")),
        ],
    )
    return LaunchDescription([*arguments, node])
