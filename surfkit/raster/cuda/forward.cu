// Blending front to back: a block draws a tile, a thread a pixel.
#include "view.h"

using namespace surfkit;

namespace {
constexpr int kBatch = 128;  // splats staged together
// Blocks of a multiprocessor, at least: as many as the registers allow with hardly a spill.
constexpr int kBlocks = kKind == kSurfel && LEVEL == kDistortion ? 3 : 4;
}

// The maps of LEVEL, and what the way back needs: what is left open of each pixel's ray, its last and its median splat,
// and the moments of distortion. In `blended`, 32 splats of a tile's list share a word for each warp, with a bit for
// each that was blended into one of the warp's pixels; those of a tile begin at 8 (offsets[tile] / 32 + tile).
KERNEL(kThreads, kBlocks)
forward(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
        Buffer<float> color, Buffer<float> alpha, Buffer<float> depth, Buffer<float> median, Buffer<float> normal,
        Buffer<float> distortion, Buffer<float> open, Buffer<int> last, Buffer<int> middle, Buffer<float> shift,
        Buffer<float> m1, Buffer<float> m2, Buffer<unsigned> blended) {
    SHARED(Staged, staged, kBatch);
    SHARED(Reach, reaches, kBatch);
    const Pixel pixel(view);
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    const long long words = (begin / 32 + pixel.tile) * kWarps;
    Ray<LEVEL> ray;
    ray.alive = pixel.is_inside;
    for (long long at = begin; at < end; at += kBatch) {
        if (!__syncthreads_or(ray.alive)) break;
        const int count = (int)min((long long)kBatch, end - at);
        if (threadIdx.x < count) {
            const Entry entry = entries[at + threadIdx.x];
            const SplatRecord r = records[entry.record];
            staged[threadIdx.x] = stage(view, pixel.tile, r);
            reaches[threadIdx.x] = reach(view, pixel.tile, r);
        }
        __syncthreads();
        for (int group = 0; group < count; group += 32) {
            const int mine = group + lane;
            bool is_near = false;
            if (mine < count) {
                const Reach s = reaches[mine];
                is_near = touches(s, pixel);
            }
            unsigned hits = 0;
            for (unsigned todo = __ballot_sync(kAllLanes, is_near); todo; todo &= todo - 1) {
                const int j = __ffs(todo) - 1;
                const Staged s = staged[group + j];
                const bool hit = ray.blend<Splat>(s.local, s, pixel.dx, pixel.dy, (int)(at - begin) + group + j);
                if (__any_sync(kAllLanes, hit)) hits |= 1u << j;
            }
            if (lane == 0) blended[words + (at - begin + group) / 32 * kWarps + warp] = hits;
            if (!__any_sync(kAllLanes, ray.alive)) break;
        }
    }
    if (!pixel.is_inside) return;
    ray.finish();
    const long long i = pixel.at;
    for (int c = 0; c < 3; c++) color[c * pixel.plane + i] = ray.color[c];
    alpha[i] = 1.0f - ray.open;
    open[i] = ray.open;
    last[i] = ray.last;
    if (LEVEL >= kGeometry) {
        depth[i] = ray.depth;
        median[i] = ray.median;
        middle[i] = ray.middle;
        for (int c = 0; c < 3; c++) normal[c * pixel.plane + i] = ray.normal[c];
    }
    if (LEVEL >= kDistortion) {
        distortion[i] = ray.bend;
        shift[i] = ray.shift;
        m1[i] = ray.m1;
        m2[i] = ray.m2;
    }
}
