// What each splat contributes to a view, where it leads, and what the splats hide of points.
#include "view.h"

using namespace surfkit;

namespace {
constexpr int kBatch = 32;
}

// Sum and number of alpha^a T^b over the pixels of the tile that each splat is blended into, by slot.
KERNEL(kThreads)
contribution(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
             float alpha_power, float open_power, Buffer<float> sums, Buffer<int> counts) {
    SHARED(Staged, staged, kBatch);
    SHARED(Reach, reaches, kBatch);
    SHARED(int, slots, kBatch);
    SHARED(float, sum_parts, kWarps* kBatch);
    SHARED(int, count_parts, kWarps* kBatch);
    const Pixel pixel(view);
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const bool is_root = alpha_power == 0.5f && open_power == 0.5f;
    float open = 1.0f;
    bool is_alive = pixel.is_inside;
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    for (long long at = begin; at < end; at += kBatch) {
        if (!__syncthreads_or(is_alive)) break;
        const int count = (int)min((long long)kBatch, end - at);
        if (threadIdx.x < count) {
            const Entry entry = entries[at + threadIdx.x];
            const SplatRecord r = records[entry.record];
            staged[threadIdx.x] = stage(view, pixel.tile, r);
            reaches[threadIdx.x] = reach(view, pixel.tile, r);
            slots[threadIdx.x] = entry.slot;
        }
        __syncthreads();
        bool is_near = false;
        if (lane < count) {
            const Reach s = reaches[lane];
            is_near = touches(s, pixel);
        }
        const unsigned near = __ballot_sync(kAllLanes, is_near);
        if (!is_near) {
            sum_parts[warp * kBatch + lane] = 0.0f;
            count_parts[warp * kBatch + lane] = 0;
        }
        __syncwarp();
        for (unsigned todo = near; todo; todo &= todo - 1) {
            const int j = __ffs(todo) - 1;
            const Staged s = staged[j];
            Splat::Pixel here;
            here.shape(s.local, pixel.dx, pixel.dy);
            const float alpha = lower(s.local.opacity * exp_negative(-here.half_rho), kAlphaMax);
            bool is_blended = kAlphaMin <= alpha && is_alive;
            const float after = open * (1.0f - alpha);
            if (is_blended && after < kTransmittanceMin) is_alive = is_blended = false;
            float term = 0;
            if (is_blended) {
                term = is_root ? root(alpha * open)
                               : exp_negative(madd(log_positive(alpha), alpha_power, log_positive(open) * open_power));
                open = after;
            }
            const float sum = warp_sum(term);
            const int number = __popc(__ballot_sync(kAllLanes, is_blended));
            if (lane == 0) {
                sum_parts[warp * kBatch + j] = sum;
                count_parts[warp * kBatch + j] = number;
            }
        }
        __syncthreads();
        if (threadIdx.x < count) {
            float sum = 0;
            int number = 0;
            for (int w = 0; w < kWarps; w++) {
                sum += sum_parts[w * kBatch + threadIdx.x];
                number += count_parts[w * kBatch + threadIdx.x];
            }
            sums[slots[threadIdx.x]] = sum;
            counts[slots[threadIdx.x]] = number;
        }
        // The next barrier is at the head of the loop.
    }
}

// Sums and numbers of each splat of `index`, over the slots from first[r] on.
KERNEL(128)
total(Buffer<const long long> index, Buffer<const int> first, Buffer<const float> sums, Buffer<const int> counts,
      Buffer<float> total_sum, Buffer<long long> total_count) {
    const long long r = blockIdx.x * 128LL + threadIdx.x;
    if (r >= index.size) return;
    Pair sum = 0;
    long long count = 0;
    for (int slot = first[r]; slot < first[r + 1]; slot++) {
        sum += sums[slot];
        count += counts[slot];
    }
    total_sum[index[r]] = (float)sum;
    total_count[index[r]] = count;
}

// Adds one to the splat that has the largest weight of a pixel, where it is that of the median depth too. Of equal
// weights the first counts. Whole numbers come to the same sum in any order, so that atomics change no bit.
KERNEL(kThreads)
leading(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
        Buffer<const long long> index, Buffer<int> count) {
    SHARED(Staged, staged, kBatch);
    SHARED(Reach, reaches, kBatch);
    const Pixel pixel(view);
    const int lane = threadIdx.x % 32;
    float open = 1.0f, most = 0.0f;
    long long top = -1, middle = -1;
    bool is_alive = pixel.is_inside;
    const long long begin = offsets[pixel.tile], end = offsets[pixel.tile + 1];
    for (long long at = begin; at < end; at += kBatch) {
        if (!__syncthreads_or(is_alive)) break;
        const int size = (int)min((long long)kBatch, end - at);
        if (threadIdx.x < size) {
            const Entry entry = entries[at + threadIdx.x];
            const SplatRecord r = records[entry.record];
            staged[threadIdx.x] = stage(view, pixel.tile, r);
            reaches[threadIdx.x] = reach(view, pixel.tile, r);
        }
        __syncthreads();
        bool is_near = false;
        if (lane < size) {
            const Reach s = reaches[lane];
            is_near = touches(s, pixel);
        }
        for (unsigned todo = __ballot_sync(kAllLanes, is_near); todo; todo &= todo - 1) {
            const int j = __ffs(todo) - 1;
            const Staged s = staged[j];
            Splat::Pixel here;
            here.shape(s.local, pixel.dx, pixel.dy);
            const float alpha = lower(s.local.opacity * exp_negative(-here.half_rho), kAlphaMax);
            if (alpha < kAlphaMin || !is_alive) continue;
            const float after = open * (1.0f - alpha), weight = alpha * open;
            if (after < kTransmittanceMin) {
                is_alive = false;
                continue;
            }
            if (weight > most) {
                most = weight;
                top = at + j;
            }
            if (open > 0.5f) middle = at + j;
            open = after;
        }
        // The next barrier is at the head of the loop.
    }
    if (middle < 0 || open > 0.5f || top != middle) return;
    const Entry entry = entries[middle];
    atomicAdd(&count[index[entry.record]], 1);
}

// 1 - product of 1 - alpha of the splats met on the way to points (x, y, z), in pixels about the centre of their tile;
// points of `order` lie in the image.
KERNEL(128)
probe(View view, Buffer<const SplatRecord> records, Buffer<const Entry> entries, Buffer<const long long> offsets,
      Buffer<const float> points, Buffer<const int> tiles, Buffer<const long long> order, Buffer<float> opacity) {
    const long long k = blockIdx.x * 128LL + threadIdx.x;
    if (k >= order.size) return;
    const long long i = order[k];
    const int tile = tiles[i];
    const float dx = points[3 * i], dy = points[3 * i + 1], z = points[3 * i + 2];
    float open = 1.0f;
    for (long long at = offsets[tile]; at < offsets[tile + 1]; at++) {
        const Entry entry = entries[at];
        const SplatRecord r = records[entry.record];
        if (z < r.z_low) continue;
        const Splat::Local local = Splat::Local::of(r, from_anchor_x(view, tile, r), from_anchor_y(view, tile, r));
        Splat::Pixel here;
        here.shape(local, dx, dy);
        const float alpha = lower(local.opacity * exp_negative(-here.half_rho), kAlphaMax);
        if (alpha < kAlphaMin) continue;
        here.depth(local);
        if (here.z <= z) open *= 1.0f - alpha;
    }
    opacity[i] = 1.0f - open;
}
