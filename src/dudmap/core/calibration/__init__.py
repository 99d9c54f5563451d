"""Self-calibration of the colour camera against the depth camera."""
