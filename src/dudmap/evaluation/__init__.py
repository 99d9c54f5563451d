"""Scores against the truth: trajectories, surfaces and dynamic masks. No part of the system uses them."""
