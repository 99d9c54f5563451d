"""Errors of trajectories, surfaces and dynamic masks against the ground truth. The SLAM system does not use them."""
