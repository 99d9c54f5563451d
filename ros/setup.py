"""Build of the ROS 2 package (ament_python); colcon calls it."""

from setuptools import setup

NAME = "dudmap_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/dudmap.launch.py"]),
        (f"share/{NAME}/config", ["config/dudmap.yaml"]),
    ],
    install_requires=["setuptools", "dudmap"],
    zip_safe=True,
    description="ROS 2 node of dudmap",
    license="MIT",
    entry_points={"console_scripts": ["dudmap_node = dudmap_ros.node:main"]},
)
