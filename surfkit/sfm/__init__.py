"""Structure from motion: a folder of photographs becomes a data set with cameras, sparse points and a place on Earth."""
