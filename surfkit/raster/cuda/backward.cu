// The way back: the gradients of a tile's splats, summed over its pixels without atomics, so that they are the same
// bits each time. A warp sums over its pixels by shuffles, the block over its warps in their order, `gather` over the
// tiles.
#include "fold.h"
#include "view.h"

using namespace surfkit;

namespace {

constexpr int kBatch = 32;
typedef AdderOf<Splat, LEVEL, CHOSEN>::Type Adder;
typedef Retrace<LEVEL, CHOSEN> Back;
static_assert(Adder::width == WIDTH, "a row of sums");

// The cotangents of one group of losses: planes, or empty where there are none.
struct Given {
    Buffer<const float> color, alpha, depth, median, normal, distortion;
};

inline float plane_at(const Buffer<const float>& plane, long long i) { return plane.size ? plane[i] : 0.0f; }

template <int level>
inline void read_cotangents(const Given& from, const Pixel& p, float open, Cotangents<level>& to) {
    for (int c = 0; c < 3; c++) to.color[c] = plane_at(from.color, c * p.plane + p.at);
    to.behind = -(plane_at(from.alpha, p.at) * open);  // alpha = 1 - T: it acts through what is left open
    if (level >= kGeometry) {
        to.depth = plane_at(from.depth, p.at);
        to.median = plane_at(from.median, p.at);
        for (int c = 0; c < 3; c++) to.normal[c] = plane_at(from.normal, c * p.plane + p.at);
    }
    if (level >= kDistortion) to.bend = plane_at(from.distortion, p.at);
}

}  // namespace

// Into `sums`, for each slot in which a splat is blended and gets a gradient, the row of sums over the tile's pixels,
// about the splat's anchor; `touched` marks these slots.
KERNEL(kThreads)
backward(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
         Buffer<const long long> index, long long rows, Buffer<const float> color, Buffer<const float> alpha,
         Buffer<const float> depth, Buffer<const float> median, Buffer<const float> normal,
         Buffer<const float> distortion, Buffer<const float> color2, Buffer<const float> alpha2,
         Buffer<const float> depth2, Buffer<const float> median2, Buffer<const float> normal2,
         Buffer<const float> distortion2, Buffer<const float> open, Buffer<const int> last, Buffer<const int> middle,
         Buffer<const float> shift, Buffer<const float> m1, Buffer<const float> m2, Buffer<const unsigned> blended,
         Buffer<float> sums, Buffer<unsigned char> touched) {
    SHARED(Staged, staged, kBatch);
    SHARED(LocalSignal, signals, kBatch);
    SHARED(int, slots, kBatch);  // -1: it only hides others
    SHARED(float2, anchors, kBatch);  // the tile's centre, less the anchor
    SHARED(unsigned, blenders, kBatch);  // a bit for each warp that it was blended in
    SHARED(float, parts, kWarps * kBatch * WIDTH);
    const Pixel pixel(view);
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    const long long words = (begin / 32 + pixel.tile) * kWarps;
    Back ray;
    ray.open = 1.0f;
    if (pixel.is_inside) {
        const long long i = pixel.at;
        ray.open = open[i];
        ray.last = last[i];
        read_cotangents({color, alpha, depth, median, normal, distortion}, pixel, ray.open, ray.total);
        if (CHOSEN) read_cotangents({color2, alpha2, depth2, median2, normal2, distortion2}, pixel, ray.open, ray.part);
        if (LEVEL >= kGeometry) ray.middle = middle[i];
        if (LEVEL >= kDistortion) {
            ray.all = 1.0f - ray.open;
            ray.shift = shift[i];
            ray.m1 = m1[i];
            ray.m2 = m2[i];
        }
    }
    for (long long batch = (end - begin + kBatch - 1) / kBatch - 1; batch >= 0; batch--) {
        unsigned of_tile = 0;
        for (int w = 0; w < kWarps; w++) of_tile |= blended[words + batch * kWarps + w];
        if (!of_tile) continue;
        const long long at = begin + batch * kBatch;
        if (threadIdx.x < kBatch && (of_tile >> threadIdx.x & 1)) {
            const Entry entry = entries[at + threadIdx.x];
            const SplatRecord r = records[entry.record];
            staged[threadIdx.x] = stage(view, pixel.tile, r);
            const float sx = from_anchor_x(view, pixel.tile, r), sy = from_anchor_y(view, pixel.tile, r);
            if (CHOSEN) signals[threadIdx.x] = LocalSignal::of({view.camera.width, view.camera.height}, r, sx, sy);
            slots[threadIdx.x] = index[entry.record] < rows ? entry.slot : -1;
            anchors[threadIdx.x] = make_float2(sx, sy);
            unsigned warps = 0;
            for (int w = 0; w < kWarps; w++)
                warps |= (blended[words + batch * kWarps + w] >> threadIdx.x & 1) << w;
            blenders[threadIdx.x] = warps;
        }
        __syncthreads();
        for (unsigned todo = blended[words + batch * kWarps + warp]; todo;) {
            const int j = 31 - __clz(todo);
            todo ^= 1u << j;
            const Staged s = staged[j];
            LocalSignal signal = {};
            if (CHOSEN) signal = signals[j];
            const bool is_fixed = slots[j] < 0;
            Adder adder;
            ray.step<Splat>(s.local, s, signal, pixel.dx, pixel.dy, (int)(at - begin) + j, is_fixed, adder);
            if (is_fixed) continue;
            const int column = fold<WIDTH>(adder.s, lane);
            if (column < WIDTH) parts[(warp * kBatch + j) * WIDTH + column] = adder.s[0];
        }
        __syncthreads();
        for (int k = threadIdx.x; k < kBatch * WIDTH; k += kThreads) {
            const int j = k / WIDTH, column = k % WIDTH;
            if (!(of_tile >> j & 1) || slots[j] < 0) continue;
            float sum = 0, shifted = 0;
            // Those of a surfel's columns 0 to 5 are about the tile's centre: the anchor is (sx, sy) away.
            const bool is_moment = kKind == kSurfel && column < 6;
            for (unsigned todo = blenders[j]; todo; todo &= todo - 1) {
                const int w = __ffs(todo) - 1;
                sum += parts[(w * kBatch + j) * WIDTH + column];
                if (is_moment) shifted += parts[(w * kBatch + j) * WIDTH + 6 + column % 3];
            }
            const float2 anchor = anchors[j];
            if (is_moment) sum += (column < 3 ? anchor.x : anchor.y) * shifted;
            sums[(long long)slots[j] * WIDTH + column] = sum;
            if (column == 0) touched[slots[j]] = 1;
        }
        __syncthreads();
    }
}
