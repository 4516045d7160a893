// The state of voxels and what one view does to a block of them; one compilation for each instruction set.
// The definition of correct is surfkit/mesh/reference_grid.py: every step here is rounded as it is there, to the same bits.
#pragma once

#include <cstdint>

#include "../voxel.h"

namespace surfkit {

// 7 bytes a voxel, x fastest. Rounding is dithered, so that means over many views do not get stuck.
struct alignas(64) Block {
    int16_t distance[kVoxels];   // in 1/32767 of the truncation, positive in front of the surface
    uint16_t weight[kVoxels];    // 32 is one view that looks straight at a surface from near; 0 is never seen
    uint8_t color[3][kVoxels];
};

struct FuseJob {
    const float* depth;      // (height, width) camera z, 0 for none
    const float* slant;      // (height, width) distance from the plane of the surface for each unit of depth
    const uint32_t* shade;   // (height, width) red, green, blue, weight from the lowest byte up
    Lens lens;
    float offsets[3][kVoxels];  // camera coordinates of each voxel less those of the first
    Band band;
};

constexpr uint64_t kNoKey = ~uint64_t{0};

// A row of pixels, and how it lies among the blocks. Lengths are in blocks.
struct RowJob {
    const float* depth;
    const uint32_t* shade;
    int width;
    double row, fx, cx, per_block;    // row: y of the ray at z = 1
    double turn[3][3], eye[3], reach;  // turn: axis of the world, then of the camera
    int32_t low[3], high[3];           // blocks that may be made, both ends included
};

constexpr float kFullWeight = 32;
constexpr float kLeastSlant = 0.26f;  // with the shortest truncation; see lattice.py

// The maps of a view, from which the shade and the slant of its pixels are made.
struct ShadeJob {
    const float *depth, *color, *normal;  // (height, width), (3, height, width), the same or null
    int width, height;
    float fx, fy, cx, cy, near, least;  // near: depth at which a pixel is as large as a voxel; least: of the slants
};

struct FuseKernels {
    // Fuse a view into a block whose first voxel lies at `first` in the camera's frame.
    void (*block)(const FuseJob& job, const float* first, uint32_t seed, Block& block);
    // Keys of the first and the last block within reach of what each pixel shows; kNoKey for none.
    void (*row)(const RowJob& job, uint64_t* low, uint64_t* high);
    // Colour and weight, and the slant, of a row of pixels.
    void (*shade)(const ShadeJob& job, int row, uint32_t* shade, float* slant);
};

const FuseKernels& fuse_kernels_baseline();
#if defined(SURFKIT_X86)
const FuseKernels& fuse_kernels_avx2();
const FuseKernels& fuse_kernels_avx512();
#endif

}  // namespace surfkit
