// A z-buffer of triangles, for pictures of meshes.
#pragma once

#include <cstdint>

namespace surfkit {

struct FaceJob {
    const float* vertices;  // (V, 3) x and y in pixels, and depth; triangles with a corner at depth 0 or less are not drawn
    const int32_t* faces;   // (F, 3)
    int64_t count;
    float* depth;   // (height, width) to begin with the largest depth to be drawn
    int32_t* face;  // (height, width) the nearest triangle; untouched where there is none
    int width, height;
};

void draw_faces(const FaceJob& job, int threads);

}  // namespace surfkit
