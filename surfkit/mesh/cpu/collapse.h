// Fewer triangles of the same surface: edges are collapsed, those first that move it least.
#pragma once

#include <cstdint>
#include <vector>

namespace surfkit {

struct CollapseJob {
    const float* vertices;  // (V, 3)
    int64_t vertex_count;
    const int32_t* faces;  // (F, 3)
    int64_t face_count;
    const uint8_t* fixed;  // (V) vertices that stay as they are
    int64_t least;         // triangles at which it ends
    bool flat;             // whether all lies in a plane, on which folds must not grow: nothing else holds them
    double limit;          // most that a collapse may cost: squared distances to planes, weighted by area in mean triangles
};

struct Collapsed {
    std::vector<float> vertices;
    std::vector<int32_t> faces;
    std::vector<int32_t> into;  // (V) vertex of the result that each stands in; -1 for those that no face has
};

Collapsed collapse(const CollapseJob& job);

}  // namespace surfkit
