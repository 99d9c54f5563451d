"""Texture of a mesh from the images of a run, without dynamic objects."""
