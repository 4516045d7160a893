"""Pictures and videos of a model along a path of the camera."""
