"""Rigid motions, cameras, trajectories and meshes."""
