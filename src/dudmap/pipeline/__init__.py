"""Runs over a recording: frames in, run folder out."""
