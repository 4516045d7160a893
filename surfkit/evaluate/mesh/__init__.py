"""A mesh by itself: edges, parts, triangles that cross, roughness. No truth is needed."""
