"""Maps of a surface: surface model, orthophoto, hillshade, contour lines, point cloud, and differences of two surfaces."""
