// Depths of the pixels of a tile where half of the light gets through gaussians as stochastic solids; see ../solids.h.
#pragma once

#include "../solids.h"
#include "kernels.h"
#include "tiles.h"

namespace surfkit {
namespace {

template <class F>
SURFKIT_INLINE void each_bit(uint64_t blocks, F f) {
    for (; blocks; blocks &= blocks - 1) f(__builtin_ctzll(blocks));
}

// A splat of a tile's list as its pixels see it.
struct Solid {
    LocalRay local;
    float sx, sy, front, back;
    uint64_t blocks;

    // Those of the `blocks` that it may touch; none if it lies behind `far`.
    Solid(const Tile& tile, const RayRecord& s, float far, uint64_t wanted)
        : local(LocalRay::of(s, tile.ox - s.ax, tile.oy - s.ay)), sx(local.sx), sy(local.sy), front(front_of(local)),
          back(back_of(local)), blocks(front < far ? touched_blocks(s, sx, sy) & wanted : 0) {}
    // False if it is not drawn at a pixel of the block.
    SURFKIT_INLINE bool at(int block, SolidPixel& pixel) const {
        pixel.shape(local, lanes().x[block], lanes().y[block]);
        if (!any(pixel.drawn)) return false;
        pixel.place(local);
        return true;
    }
};

// The least and the largest depth that some pixels of a block are looked at.
struct Interval {
    float low = 1e30f, high = 0;
    void add(const Floats& from, const Floats& to, Mask which) {
        const uint32_t on = bits(which);
        for (int l = 0; l < kLanes; l++)
            if (on >> l & 1) low = from[l] < low ? from[l] : low, high = to[l] > high ? to[l] : high;
    }
};

// The search in a tile. What lies before all depths that a block is looked at is multiplied once, into `base`.
struct SolidSearch {
    const Tile& tile;
    Crossing crossing[kBlocks];
    Floats start[kBlocks], at[kBlocks][kParts], left[kBlocks][kParts], base[kBlocks], fall[kBlocks];
    float counted[kBlocks];  // up to where `base` holds what lies before
    Interval interval[kBlocks];

    SolidSearch(const Tile& t) : tile(t) {
        for (int b = 0; b < kBlocks; b++) counted[b] = -1e30f, base[b] = broadcast(1.0f), start[b] = fall[b] = Floats{};
    }
    // What is left open at `count` depths of the pixels of some blocks, in growing order; with `falls` of one, and the
    // fall there too.
    void look(uint64_t blocks, int count, bool falls) {
        float far = 0;
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            far = interval[b].high > far ? interval[b].high : far;
            if (interval[b].low < counted[b]) counted[b] = -1e30f, base[b] = broadcast(1.0f);
            for (int i = 0; i < count; i++) left[b][i] = broadcast(1.0f);
            fall[b] = Floats{};
        });
        for (int64_t k = tile.begin; k < tile.end && blocks; k++) {
            fetch<Rays, 8>(tile, k);
            const Solid solid(tile, record_of<Rays>(tile, k), far, blocks);
            each_bit(solid.blocks, [&](int bit) {
                const int b = block_at(bit);
                SolidPixel pixel;
                if (solid.back < counted[b] || interval[b].high < solid.front || !solid.at(b, pixel)) return;
                if (solid.back < interval[b].low) {
                    base[b] = base[b] * pixel.open_squared(interval[b].low + Floats{});
                    return;
                }
                for (int i = 0; i < count; i++) left[b][i] = left[b][i] * pixel.open_squared(at[b][i]);
                if (falls) fall[b] = fall[b] + pixel.fall(at[b][0]);
            });
        }
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            counted[b] = interval[b].low > counted[b] ? interval[b].low : counted[b];
            for (int i = 0; i < count; i++) left[b][i] = left[b][i] * base[b];
        });
    }
    Floats open_ones(int b, int count) const {
        Floats sum{};
        for (int i = 0; i < count; i++) sum = sum + keep(lesser(0.25f, left[b][i]), broadcast(1.0f));
        return sum;
    }
    // Finds intervals for those pixels that have none yet; the blocks where some have one.
    uint64_t begin(uint64_t blocks, bool wide) {
        uint64_t wanted = 0, found = 0;
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            const Mask lacking = without(lesser(0.0f, start[b]), crossing[b].found);
            if (!any(lacking)) return;
            wanted |= 1ull << bit;
            for (int i = 0; i < kShares; i++) at[b][i] = start[b] * share_of(wide, i);
            interval[b] = {};
            interval[b].add(at[b][0], at[b][kShares - 1], lacking);
        });
        look(wanted, kShares, false);
        each_bit(wanted, [&](int bit) {
            const int b = block_at(bit);
            crossing[b].begin(start[b], open_ones(b, kShares), wide);
        });
        each_bit(blocks, [&](int bit) {
            if (any(crossing[block_at(bit)].found)) found |= 1ull << bit;
        });
        return found;
    }
    void bracketed(uint64_t blocks) {
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            interval[b] = {};
            interval[b].add(crossing[b].low, crossing[b].high, crossing[b].found);
        });
    }
    void narrow(uint64_t blocks) {
        bracketed(blocks);
        each_bit(blocks, [&](int bit) {
            for (int i = 0; i < kParts - 1; i++) at[block_at(bit)][i] = crossing[block_at(bit)].inner(i);
        });
        look(blocks, kParts - 1, false);
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            crossing[b].narrow(open_ones(b, kParts - 1));
        });
    }
    void newton(uint64_t blocks) {
        bracketed(blocks);
        each_bit(blocks, [&](int bit) { at[block_at(bit)][0] = crossing[block_at(bit)].t; });
        look(blocks, 1, true);
        each_bit(blocks, [&](int bit) {
            const int b = block_at(bit);
            crossing[b].newton(left[b][0], fall[b]);
        });
    }
};

// Puts these depths in the place of the median ones, about which the search begins, and keeps them and the fall of the
// light there for the way back. Then no single splat is that of the median.
inline void solid_tile(const Tile& tile, float near, const Planes& out, const Saved& saved) {
    SolidSearch search(tile);
    uint64_t blocks = 0;
    each_bit(tile.inside(), [&](int bit) {
        const int b = block_at(bit);
        search.start[b] = tile.read(out.median, b);
        if (any(lesser(0.0f, search.start[b]))) blocks |= 1ull << bit;
    });
    uint64_t found = search.begin(blocks, false);
    found = search.begin(blocks, true);
    for (int i = 0; i < kNarrowings; i++) search.narrow(found);
    for (int i = 0; i < kNewton; i++) search.newton(found);
    const Ints none = Ints{} - 1;
    each_bit(tile.inside(), [&](int bit) {
        const int b = block_at(bit);
        const Floats depth = search.crossing[b].depth(near);
        const Floats fall = keep(lesser(kLeastFall, search.fall[b] * depth), search.fall[b]);
        tile.write(out.median, b, (const float*)&depth);
        tile.write(saved.solid, b, (const float*)&depth);
        tile.write(saved.fall, b, (const float*)&fall);
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
        Interval seen;
        seen.add(depth[b], depth[b], falls);
        farthest[b] = seen.high;
        far = seen.high > far ? seen.high : far;
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
