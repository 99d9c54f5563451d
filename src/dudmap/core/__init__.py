"""The algorithm: from a frame to a pose, a mask and a map. It knows no file format, data set, viewer or command."""
