// The state of voxels and what one view does to a block of them; one compilation for each instruction set.
// The definition of correct is surfkit/mesh/reference.py: every step here is rounded as it is there, to the same bits.
#pragma once

#include <cstdint>

namespace surfkit {

constexpr int kSide = 8;  // voxels
constexpr int kVoxels = kSide * kSide * kSide;

// 7 bytes a voxel, x fastest. Rounding is dithered, so that means over many views do not get stuck.
struct alignas(64) Block {
    int16_t distance[kVoxels];   // in 1/32767 of the truncation, positive in front of the surface
    uint16_t weight[kVoxels];    // 32 is one view that looks straight at a surface from near; 0 is never seen
    uint8_t color[3][kVoxels];
};

struct FuseJob {
    const float* depth;      // (height, width) camera z, 0 for none
    const uint32_t* shade;   // (height, width) red, green, blue, weight from the lowest byte up
    int width, height;
    float fx, fy, cx, cy;
    float offsets[3][kVoxels];  // camera coordinates of each voxel less those of the first
    float truncation, jump, fade;  // fade: depth behind the surface at which the weight begins to fall
};

using FuseBlock = void (*)(const FuseJob& job, const float* first, uint32_t seed, Block& block);

void fuse_block_baseline(const FuseJob& job, const float* first, uint32_t seed, Block& block);
#if defined(SURFKIT_X86)
void fuse_block_avx2(const FuseJob& job, const float* first, uint32_t seed, Block& block);
void fuse_block_avx512(const FuseJob& job, const float* first, uint32_t seed, Block& block);
#endif

}  // namespace surfkit
