// Whether the depth maps of several photographs describe one surface: see agreement in depth/consistency.py.
#pragma once

#include <vector>

namespace surfkit {

// Inverse depths of another photograph. The ray (x, y, 1) of a pixel, at inverse depth w, falls on A (x, y, 1) + w b,
// over the third component, and the third over w is the depth there.
struct AgreementMap {
    const float* inverse;  // (height, width), 0 for none
    int width, height;
    double way[12];  // A by rows, then b
};

struct AgreementJob {
    const float* inverse;  // (height, width), 0 for none
    int width, height;
    double fx, fy, cx, cy;
    std::vector<AgreementMap> others;
    float tolerance;               // share of the depth
    float *count, *shown, *fused;  // as `inverse`, to be written
};

void agreement(const AgreementJob& job, int row);

}  // namespace surfkit
