"""The camera pose of a frame: prediction, registration and acceptance."""
