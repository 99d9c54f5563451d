"""The algorithm: from a frame to a pose, a mask and a map. It knows no file, data set, viewer or command."""
