"""Joining maps of different runs: relative pose by features and distances, checks, and exact fusion by blocks."""
