// Depths where half of the light gets through gaussians as stochastic solids (../solids.h), and the way back: a block
// draws a tile, a thread a pixel.
#include "fold.h"
#include "view.h"
#include "../solids.h"

using namespace surfkit;

namespace {

constexpr int kBatch = 128, kBatchBack = 32;  // splats staged together
typedef RayAdder<kGeometry, CHOSEN> Adder;
static_assert(kKind == kGaussianRay, "solids are gaussians along rays");

// The largest of a warp, in all of its lanes.
inline float warp_largest(float value) {
#pragma unroll
    for (int step = 16; step > 0; step /= 2) value = fmaxf(value, __shfl_xor_sync(kAllLanes, value, step));
    return value;
}

// Calls f(solid) for the splats of a tile's list that may touch a pixel of the thread's warp, and begin before `far` of
// one of them, where `is_wanted`. All threads of the block arrive.
template <class F>
inline void each_solid(const View& view, const Pixel& pixel, const Buffer<const SplatRecord>& records,
                       const Buffer<const Entry>& entries, long long begin, long long end,
                       SharedArray<LocalRay> locals, SharedArray<Reach> reaches, bool is_wanted, float far, F f) {
    const int lane = threadIdx.x % 32;
    const float farthest = warp_largest(is_wanted ? far : 0.0f);
    for (long long at = begin; at < end; at += kBatch) {
        if (!__syncthreads_or(is_wanted)) break;
        const int count = (int)min((long long)kBatch, end - at);
        if (threadIdx.x < count) {
            const SplatRecord r = records[Entry(entries[at + threadIdx.x]).record];
            locals[threadIdx.x] = stage(view, pixel.tile, r).local;
            reaches[threadIdx.x] = reach(view, pixel.tile, r);
        }
        __syncthreads();
        for (int group = 0; group < count; group += 32) {
            const int mine = group + lane;
            bool is_near = false;
            if (mine < count) {
                const Reach s = reaches[mine];
                const LocalRay local = locals[mine];
                is_near = front_of(local) < farthest && touches(s, pixel);
            }
            for (unsigned todo = __ballot_sync(kAllLanes, is_near); todo; todo &= todo - 1) {
                const LocalRay local = locals[group + __ffs(todo) - 1];
                SolidPixel solid;
                if (solid.shape(local, pixel.dx, pixel.dy)) f(solid);
            }
        }
    }
}

}  // namespace

// The depth of each pixel in the place of its median one, about which the search begins; and, for the way back, that
// depth and how fast the light falls there. Then no single splat is that of the median.
KERNEL(kThreads)
solid(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
      Buffer<float> median, Buffer<int> middle, Buffer<float> depth, Buffer<float> fall) {
    SHARED(LocalRay, locals, kBatch);
    SHARED(Reach, reaches, kBatch);
    const Pixel pixel(view);
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    const float start = pixel.is_inside ? median[pixel.at] : 0.0f;
    Crossing search = {};
    const auto look = [&](bool is_wanted, float far, auto f) {
        each_solid(view, pixel, records, entries, begin, end, locals, reaches, is_wanted, far, f);
    };
    for (int wide = 0; wide < 2; wide++) {
        float left[kShares];
        for (int i = 0; i < kShares; i++) left[i] = 1;
        const bool is_wanted = start > 0 && !search.found;
        look(is_wanted, start * share_of(wide, kShares - 1), [&](const SolidPixel& solid) {
#pragma unroll
            for (int i = 0; i < kShares; i++) left[i] *= solid.open_squared(start * share_of(wide, i));
        });
        if (is_wanted) search.begin(start, left, wide);
    }
    float falls = 0;
    for (int i = 0; i < kSteps && __syncthreads_or(search.unsettled()); i++) {
        float left = 1, fall_here = 0;
        look(search.found, search.high, [&](const SolidPixel& solid) {
            left *= solid.open_squared(search.t);
            fall_here += solid.fall(search.t);
        });
        if (!search.unsettled()) continue;
        falls = fall_here;
        search.newton(left, falls);
    }
    if (!pixel.is_inside) return;
    const float t = search.depth((float)view.camera.near);
    median[pixel.at] = t;
    depth[pixel.at] = t;
    fall[pixel.at] = falls * t > kLeastFall ? falls : 0.0f;
    middle[pixel.at] = -1;
}

// Adds to the rows of sums that `backward` wrote, or writes where it did not, what these depths hand back; with `median2`
// the chosen signal too.
KERNEL(kThreads)
solid_backward(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries,
               Buffer<const long long> offsets, Buffer<const long long> index, long long rows,
               Buffer<const float> median, Buffer<const float> median2, Buffer<const float> depth,
               Buffer<const float> fall, Buffer<float> sums, Buffer<unsigned char> touched) {
    SHARED(LocalRay, locals, kBatchBack);
    SHARED(Reach, reaches, kBatchBack);
    SHARED(LocalSignal, signals, kBatchBack);
    SHARED(int, slots, kBatchBack);  // -1: it gets no gradient
    SHARED(bool, has_sums, kBatchBack);
    SHARED(unsigned, hits, kWarps);  // of each warp, a bit for each splat
    SHARED(float, parts, kWarps * kBatchBack * WIDTH);
    const Pixel pixel(view);
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    float t = 0, by_log = 0, chosen_by_log = 0;
    if (pixel.is_inside && fall[pixel.at] > 0) {
        t = depth[pixel.at];
        const float inverse = 1 / fall[pixel.at];
        if (median.size) by_log = median[pixel.at] * inverse;
        if (median2.size) chosen_by_log = median2[pixel.at] * inverse;
    }
    const float farthest = warp_largest(t);
    for (long long at = begin; at < end; at += kBatchBack) {
        if (!__syncthreads_or(t > 0)) break;
        const int count = (int)min((long long)kBatchBack, end - at);
        if (threadIdx.x < count) {
            const Entry entry = entries[at + threadIdx.x];
            const SplatRecord r = records[entry.record];
            const float sx = from_anchor_x(view, pixel.tile, r), sy = from_anchor_y(view, pixel.tile, r);
            locals[threadIdx.x] = LocalRay::of(r, sx, sy);
            reaches[threadIdx.x] = reach(r, sx, sy);
            signals[threadIdx.x] = LocalSignal::of({view.camera.width, view.camera.height}, r, sx, sy);
            slots[threadIdx.x] = index[entry.record] < rows ? entry.slot : -1;
            has_sums[threadIdx.x] = touched[entry.slot] != 0;
        }
        __syncthreads();
        bool is_near = false;
        if (lane < count && slots[lane] >= 0) {
            const Reach s = reaches[lane];
            const LocalRay local = locals[lane];
            is_near = front_of(local) < farthest && touches(s, pixel);
        }
        const unsigned todo_here = __ballot_sync(kAllLanes, is_near);
        if (lane == 0) hits[warp] = todo_here;
        for (unsigned todo = todo_here; todo; todo &= todo - 1) {
            const int j = __ffs(todo) - 1;
            const LocalRay local = locals[j];
            const LocalSignal signal = signals[j];
            SolidPixel solid;
            Adder adder;
            if (solid.shape(local, pixel.dx, pixel.dy))
                add_solid<Adder, CHOSEN>(solid, local, signal, t, by_log, chosen_by_log, adder);
            const int column = fold<WIDTH>(adder.s, lane);
            if (column < WIDTH) parts[(warp * kBatchBack + j) * WIDTH + column] = adder.s[0];
        }
        __syncthreads();
        for (int k = threadIdx.x; k < kBatchBack * WIDTH; k += kThreads) {
            const int j = k / WIDTH, column = k % WIDTH;
            float sum = 0;
            bool is_hit = false;
            for (int w = 0; w < kWarps; w++) {
                if (!(hits[w] >> j & 1)) continue;
                sum += parts[(w * kBatchBack + j) * WIDTH + column];
                is_hit = true;
            }
            if (!is_hit) continue;
            const long long to = (long long)slots[j] * WIDTH + column;
            sums[to] = has_sums[j] ? sums[to] + sum : sum;
            if (column == 0) touched[slots[j]] = 1;
        }
    }
}
