// What a photograph shows of each triangle.
#pragma once

#include <cstdint>

namespace surfkit {

struct LookJob {
    const float* vertices;  // (V, 3) x and y in pixels, and depth
    const int32_t* faces;   // (F, 3)
    int64_t count;
    const float* depth;    // (height, width) of the nearest surface; 0 hides everything, inf nothing
    const uint8_t* color;  // (3, height, width)
    int width, height;
    float slack;       // share of its depth by which a place may lie behind the nearest surface and be seen
    int32_t* covered;  // (F) pixels whose centre a triangle covers; at least 1, and 0 if it does not lie in the picture
    int32_t* hidden;   // (F) of these, those on which something is nearer
    float* sums;       // (F, 3) of the colours of the others
};

void look(const LookJob& job, int threads);

}  // namespace surfkit
