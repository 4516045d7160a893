"""Structure from motion: a folder of photographs becomes a data set with cameras and points, on the map."""
