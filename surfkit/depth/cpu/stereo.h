// PatchMatch stereo: planes of a picture that are tried against other pictures.
#pragma once

#include <cstdint>

#include "../stereo_terms.h"

namespace surfkit {

// A picture to compare with. A pixel (x, y) of inverse depth w falls on the pixel a (x, y, 1) + b w of it, over the third
// component; pixels are numbered from the middle of the first one.
struct StereoSource {
    // Two bytes: a grey value and the one below; continued by kBorder on each side, and one more to the right.
    const uint16_t* pixels;
    int width, height, stride;
    float gain;  // times its grey values, so that it is as bright as the picture whose planes are sought
    float way[12];  // a, then b
    // Inverse depths of that picture, for geometric consistency, or null; and the way back.
    const float* inverse;
    int inverse_width, inverse_height;
    float to_inverse[2];  // from pixels of the picture to pixels of the map
    float back[12];
};

// State and settings of one picture. A plane is an inverse depth and its slopes: in the picture, inverse depth is linear on
// a plane.
struct StereoJob {
    const float* image;  // height + 2 kRadius rows of width + 2 kRadius grey values in [0, 255]
    int width, height;
    float fx, fy, cx, cy;
    const float *offset_x, *offset_y, *nearness;  // kSamples pixels of a window and their weights; whole numbers
    const StereoSource* sources;
    int views;
    float* plane;    // (height, width, 3) inverse depth, change per pixel to the right, per pixel down
    float* cost;     // (height, width)
    uint8_t* each;   // (height, width, views) costs of the present plane by view, 255 for 1 and worse
    float low, high;     // inverse depths
    float parallax;      // pixels by which a picture moves, a unit of inverse depth
    float jitter_px;     // by which planes are changed at random
    float smoothness;    // cost of a difference of one pixel of parallax from the neighbours
    float consistency;   // cost of a reprojection error of one pixel
    float brightness;    // cost of a relative difference of brightness between a window and what a view shows
    float spread;        // difference of grey values at which a pixel of the window counts 1 / e
    float alike[256];    // what pixels of such a difference count
    float stretch;       // most pixels of a view that one pixel of a window may cover: its window must stay within kBorder
    int samples;         // pixels of a window that are compared, the first ones; a multiple of 16
    int best;            // views that count
    bool survey;         // look at all views anew, to choose those that count
    uint32_t seed;
};

struct StereoKernels {
    // Improve the planes of the pixels of a row whose x + y has the parity of `colour`.
    void (*improve)(const StereoJob&, int row, int colour);
};

const StereoKernels& stereo_kernels_baseline();
const StereoKernels& stereo_kernels_avx2();
const StereoKernels& stereo_kernels_avx512();
const StereoKernels& stereo_kernels_avx512_gather();

}  // namespace surfkit
