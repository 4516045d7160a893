// Depths of the pixels of a tile where half of the light gets through gaussians as stochastic solids; see ../solids.h.
#pragma once

#include <vector>

#include "../solids.h"
#include "kernels.h"
#include "tiles.h"

namespace surfkit {
namespace {

template <class F>
SURFKIT_INLINE void each_bit(uint64_t blocks, F f) {
    for (; blocks; blocks &= blocks - 1) f(__builtin_ctzll(blocks));
}

// A splat of a tile's list, and those of some blocks that it may touch: none if it lies behind `far`.
struct Solid {
    LocalRay local;
    float sx, sy, front;
    uint64_t blocks;

    Solid(const Tile& tile, const RayRecord& s, float far, uint64_t wanted)
        : local(LocalRay::of(s, tile.ox - s.ax, tile.oy - s.ay)),
          sx(local.sx),
          sy(local.sy),
          front(front_of(local)),
          blocks(front < far ? touched_blocks(s, sx, sy) & wanted : 0) {}
    SURFKIT_INLINE bool at(int block, SolidPixel& pixel) const {
        return pixel.shape(local, lanes().x[block], lanes().y[block]);
    }
};
inline float largest_of(Floats v) {
    float most = v[0];
    for (int l = 1; l < kLanes; l++) most = v[l] > most ? v[l] : most;
    return most;
}

// The search of a block: what its rays meet, less and less of it.
struct SolidSearch {
    std::vector<OnRay>& met;
    Floats base = broadcast(1.0f);  // the square of what those leave open that lie before all depths in question
    Crossing crossing;
    Floats fall{};

    // Of depths between `low` and `high`, where they are in question.
    void keep_between(Floats low, Floats high, Mask which) {
        size_t kept = 0;
        for (const OnRay& one : met) {
            const Mask here = which & lesser(0.0f, one.raw);
            if (!any(without(here, one.lies_before(low)))) {
                base = base * one.behind();
            } else if (any(without(here, one.lies_behind(high)))) {
                met[kept++] = one;
            }
        }
        met.resize(kept);
    }
    // About `start`, where it is not 0.
    void look(Floats start, bool wide) {
        Floats at[kShares], left[kShares];
        for (int i = 0; i < kShares; i++) at[i] = start * share_of(wide, i);
        keep_between(at[0], at[kShares - 1], lesser(0.0f, start));
        for (int i = 0; i < kShares; i++) left[i] = base;
        for (const OnRay& one : met)
            for (int i = 0; i < kShares; i++) left[i] = left[i] * one.open_squared(at[i]);
        crossing.begin(start, left, wide);
        if (any(crossing.found)) keep_between(crossing.low, crossing.high, crossing.found);
        for (int i = 0; i < kSteps && any(crossing.unsettled()); i++) {
            Floats open = base;
            fall = Floats{};
            for (const OnRay& one : met) {
                open = open * one.open_squared(crossing.t);
                fall = fall + one.fall(crossing.t);
            }
            crossing.newton(open, fall);
        }
    }
};

// Puts these depths in the place of the median ones, about which the search begins, and keeps them and the fall of the
// light there for the way back. Then no single splat is that of the median.
inline void solid_tile(const Tile& tile, float near, const Planes& out, const Saved& saved) {
    thread_local std::vector<OnRay> met[kBlocks];
    Floats start[kBlocks] = {}, depth[kBlocks] = {}, fall[kBlocks] = {};
    uint64_t wanted = 0;
    each_bit(tile.inside(), [&](int bit) {
        const int b = block_at(bit);
        start[b] = tile.read(out.median, b);
        if (any(lesser(0.0f, start[b]))) wanted |= 1ull << bit;
    });
    for (int wide = 0; wide < 2; wide++) {
        float far = 0;
        each_bit(wanted, [&](int bit) {
            met[block_at(bit)].clear();
            const float most = largest_of(start[block_at(bit)]) * share_of(wide, kShares - 1);
            far = most > far ? most : far;
        });
        for (int64_t k = tile.begin; k < tile.end && wanted; k++) {
            fetch<Rays, 8>(tile, k);
            const Solid solid(tile, record_of<Rays>(tile, k), far, wanted);
            each_bit(solid.blocks, [&](int bit) {
                SolidPixel pixel;
                if (solid.at(block_at(bit), pixel)) met[block_at(bit)].push_back(pixel);
            });
        }
        uint64_t lacking = 0;
        each_bit(wanted, [&](int bit) {
            const int b = block_at(bit);
            SolidSearch search{met[b]};
            search.look(start[b], wide);
            const Mask found = search.crossing.found;
            depth[b] = select(found, search.crossing.depth(near), depth[b]);
            fall[b] = select(found, search.fall, fall[b]);
            start[b] = keep(without(lesser(0.0f, start[b]), found), start[b]);
            if (any(lesser(0.0f, start[b]))) lacking |= 1ull << bit;
        });
        wanted = lacking;
    }
    const Ints none = Ints{} - 1;
    each_bit(tile.inside(), [&](int bit) {
        const int b = block_at(bit);
        const Floats steep = keep(lesser(kLeastFall, fall[b] * depth[b]), fall[b]);
        tile.write(out.median, b, (const float*)&depth[b]);
        tile.write(saved.solid, b, (const float*)&depth[b]);
        tile.write(saved.fall, b, (const float*)&steep);
        tile.write(saved.middle, b, (const int32_t*)&none);
    });
}

// Adds to the sums of each slot what these depths hand back.
template <int chosen>
void solid_backward_tile(const Tile& tile, const Planes& total, const Planes& part, const Saved& saved, float* sums,
                         uint8_t* touched_slots) {
    using Adder = RayAdder<kGeometry, chosen>;
    Floats depth[kBlocks], by_log[kBlocks], chosen_by_log[kBlocks];
    float farthest[kBlocks], far = 0;
    uint64_t blocks = 0;
    each_bit(tile.inside(), [&](int bit) {
        const int b = block_at(bit);
        const Floats fall = tile.read(saved.fall, b);
        const Mask falls = lesser(0.0f, fall);
        if (!any(falls)) return;
        blocks |= 1ull << bit;
        const Floats inverse = keep(falls, reciprocal(select(falls, fall, broadcast(1.0f))));
        depth[b] = tile.read(saved.solid, b);
        farthest[b] = largest_of(keep(falls, depth[b]));
        far = farthest[b] > far ? farthest[b] : far;
        by_log[b] = tile.read(total.median, b) * inverse;
        chosen_by_log[b] = tile.read(part.median, b) * inverse;
    });
    for (int64_t k = tile.begin; k < tile.end && blocks; k++) {
        fetch<Rays, 8>(tile, k);
        const Entry entry = tile.job.entries[k];
        if (tile.job.index[entry.record] >= tile.job.rows) continue;
        const RayRecord& s = record_of<Rays>(tile, k);
        const Solid solid(tile, s, far, blocks);
        if (!solid.blocks) continue;
        const LocalSignal signal = LocalSignal::of({tile.job.width, tile.job.height}, s, solid.sx, solid.sy);
        Adder adder;
        bool hit = false;
        each_bit(solid.blocks, [&](int bit) {
            const int b = block_at(bit);
            SolidPixel pixel;
            if (farthest[b] < solid.front || !solid.at(b, pixel)) return;
            add_solid<Adder, chosen>(pixel, solid.local, signal, depth[b], by_log[b], chosen_by_log[b], adder);
            hit = true;
        });
        if (!hit) continue;
        float found[Adder::width];
        sum_lanes(adder.s, Adder::width, found);
        float* const out = sums + (size_t)entry.slot * Adder::width;
        const bool more = touched_slots[entry.slot];
        for (int i = 0; i < Adder::width; i++) out[i] = more ? out[i] + found[i] : found[i];
        touched_slots[entry.slot] = 1;
    }
}

}  // namespace
}  // namespace surfkit
