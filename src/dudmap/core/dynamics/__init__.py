"""Labelling of the static and dynamic pixels of a registered frame."""
