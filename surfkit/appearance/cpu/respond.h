// Colours of a scene as a photograph shows them: appearance/camera_response.py has the formulas.
#pragma once

#include <cstdint>

namespace surfkit {

struct RespondJob {
    const float* color;        // (3, height, width)
    const float *x, *y;        // (width), (height): places on the sensor
    float stops[3];            // of each channel
    float falloff[3];          // stops at r^2, r^4, r^6
    float centre[2];           // where r is 0
    float curve[3];            // its terms
    int width, height;
    float *out, *slope;        // (3, height, width) colours, and their derivatives; negative where they were above 1
};

struct RespondKernels {
    void (*respond)(const RespondJob& job, int y0, int y1);
    // Of `count` values: grad * |slope|, but 0 where the slope is negative and the gradient too.
    void (*respond_backward)(const float* grad, const float* slope, int64_t count, float* out);
};

const RespondKernels& respond_kernels_baseline();
#if defined(SURFKIT_X86)
const RespondKernels& respond_kernels_avx2();
const RespondKernels& respond_kernels_avx512();
#endif

}  // namespace surfkit
