// How well the depth of one view agrees with that of another: see compare in mesh/agreement.py.
#pragma once

#include "../voxel.h"

namespace surfkit {

struct AgreeJob {
    const float* depth;  // (lens.height, lens.width); 0 for none
    const float* other;  // (other_height, other_width)
    int other_width, other_height;
    Lens lens;        // of the pixels
    double way[12];   // 3 x 3 A by rows and b: the ray r of a pixel, at inverse depth w, falls on A r + b w, over its third
    float eye[3];     // of the other view, in the frame of this one
    float tolerance;  // share of the depth
    float *agreement, *against, *looks;  // as depth, to be written
};

void agree(const AgreeJob& job, int row);

}  // namespace surfkit
