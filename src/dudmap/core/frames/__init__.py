"""From a camera frame to the image pyramid that is registered and labelled."""
