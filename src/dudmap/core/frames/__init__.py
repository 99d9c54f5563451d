"""Preparation of a camera frame, up to the image pyramid that is registered and labelled."""
