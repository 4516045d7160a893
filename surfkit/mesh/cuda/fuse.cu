// Depth maps into blocks of voxels; see mesh/cuda/grid.py. The arithmetic is that of the CPU, to the same bits.
#include "../voxel.h"

using namespace surfkit;

// A view of the lattice. Lengths of `eye` and `reach` are in blocks, all others in units of the world.
struct View {
    double turn[9], shift[3];  // world to camera, by rows
    double eye[3], side, per_block, reach;
    int low[3], high[3];  // blocks that may be made, both ends included
    Lens lens;
    Band band;
};

namespace {
constexpr int kThreads = 128;
}

// The blocks within reach of what each pixel shows: the key of the first times 8, and from the lowest bit up whether
// there is a second one along x, y and z; -1 for none. Half the reach is below a block, so there are no more.
KERNEL(256)
reach(View view, Buffer<const float> depth, Buffer<const unsigned> shade, Buffer<long long> found) {
    const long long i = blockIdx.x * 256LL + threadIdx.x;
    if (i >= depth.size) return;
    const int column = (int)(i % view.lens.width), row = (int)(i / view.lens.width);
    const double d = depth[i], w = d * view.per_block;
    const double u = ((double)column + 0.5 - view.lens.cx) / view.lens.fx * w;
    const double v = ((double)row + 0.5 - view.lens.cy) / view.lens.fy * w;
    bool there = d > 0 && shade[i] >> 24;
    int first[3], more = 0;
    for (int axis = 0; axis < 3; axis++) {
        const double at = view.turn[axis] * u + view.turn[3 + axis] * v + view.turn[6 + axis] * w + view.eye[axis];
        const int from = block_of(at - view.reach), to = block_of(at + view.reach);
        first[axis] = from > view.low[axis] ? from : view.low[axis];
        const int last = to < view.high[axis] ? to : view.high[axis];
        there = there && first[axis] <= last;
        more |= (first[axis] < last) << axis;
    }
    found[i] = there ? (long long)(packed(first[0], first[1], first[2]) << 3 | (Key)more) : -1;
}

// Average a view into the voxels of some blocks, a block of threads each. `rows` are places in `keys`; the voxels of the
// block at place `begin` come first in `distance`, `weight` and `color`.
KERNEL(kThreads)
fuse(View view, Buffer<const long long> keys, Buffer<const long long> rows, long long begin,
     Buffer<const float> offsets, Buffer<const float> depth, Buffer<const float> slant, Buffer<const unsigned> shade,
     Buffer<short> distance, Buffer<unsigned short> weight, Buffer<unsigned char> color) {
    SHARED(float, corner, 3);  // camera coordinates of the first voxel
    const long long row = rows[blockIdx.x];
    const Key key = (Key)(long long)keys[row];
    if (threadIdx.x < 3) {
        const int r = 3 * threadIdx.x;
        corner[threadIdx.x] =
            (float)(view.turn[r] * (part(key, 0) * view.side) + view.turn[r + 1] * (part(key, 1) * view.side) +
                    view.turn[r + 2] * (part(key, 2) * view.side) + view.shift[threadIdx.x]);
    }
    __syncthreads();
    const unsigned seed = (unsigned)mixed(key);
    const long long block = row - begin;
    for (int voxel = threadIdx.x; voxel < kVoxels; voxel += kThreads) {
        const Place p = place(view.lens, corner[0] + offsets[voxel], corner[1] + offsets[kVoxels + voxel],
                              corner[2] + offsets[2 * kVoxels + voxel]);
        if (!p.inside) continue;
        const float steep = slant[p.pixel];
        float d = depth[p.pixel];
        if (!may_count(view.band, d, p.z, steep)) continue;
        if (may_be_near(view.band, d, p.z, steep))
            d = between(view.band, depth[p.above + p.left], depth[p.above + p.right], depth[p.below + p.left],
                        depth[p.below + p.right], p.at_x, p.at_y, d, steep);
        const unsigned seen = shade[p.pixel];
        const float added = added_weight(view.band, 1, d, p.z, steep, seen);
        if (!(added > 0)) continue;
        const long long at = block * kVoxels + voxel;
        const float before = (float)weight[at];
        const Shares shared = shares(before, added);
        const unsigned noise = dither(seed, voxel, before);
        weight[at] = (unsigned short)(int)shared.weight;
        const float now = seen_distance(view.band, d, p.z, steep);
        distance[at] = (short)mean_distance((float)distance[at], now, shared.distance, noise);
        for (int channel = 0; channel < 3; channel++) {
            const long long c = (3 * block + channel) * kVoxels + voxel;
            color[c] = (unsigned char)mean_color((float)color[c], seen, channel, shared.color, noise);
        }
    }
}
