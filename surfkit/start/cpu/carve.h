// Space that trusted depth maps see through, in a grid whose last axis is up.
#pragma once

#include <cstdint>

namespace surfkit {

// Voxels in the order [x][y][z]; z is up.
struct CarveGrid {
    int size[3];
};

// A depth map, and the way from the grid to its camera: the middle of voxel (i, j, k) lies at pose (i, j, k, 1), its depth
// in voxels.
struct CarveView {
    const float* depth;  // (height, width) voxels, 0 where it is not trusted
    int width, height;
    double fx, fy, cx, cy;
    double pose[12];
    double near, beyond;  // voxels; the second is the larger
    int low[2], high[2];  // columns along x and y that it may see: from, to
};

// Count, for each voxel, a view more that sees a surface within `near` voxels of its middle, or that sees through it: a
// surface more than `beyond` voxels behind it. Counts end at 255.
void carve(const CarveGrid& grid, const CarveView& view, uint8_t* surfaces, uint8_t* through, int threads);

// Where each of `count` rays from `from` first meets a solid voxel, in steps of half a voxel: lengths along the rays, which
// need no unit length, 0 where it meets none; and directions (count, 3) from the solid around there, not of unit length.
void meet(const CarveGrid& grid, const uint8_t* solid, const double* from, const float* rays, int64_t count, float* lengths,
          float* outward, int threads);

}  // namespace surfkit
