"""Maps of a surface: heights, orthophoto, hillshade, contour lines, point cloud, differences, volumes."""
