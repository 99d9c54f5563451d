"""Compiled loops of the thesis' system."""
