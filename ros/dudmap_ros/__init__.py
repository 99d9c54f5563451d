"""ROS 2 node of dudmap."""
