// The per-pixel kernels. Compiled three times (AVX-512, AVX2, baseline) with SURFKIT_KERNELS naming the table to
// define.
#include "../native/simd.h"

#define SPLAT_FN static SURFKIT_INLINE
#include "doubles.h"
#include "../pixels.h"
#include "../project.h"
#include "kernels.h"
#include "colors.h"
#include "images.h"
#include "solid_tiles.h"
#include "surfels.h"
#include "tiles.h"

namespace surfkit {
namespace {

// ---- forward

template <class K, int level>
void forward_tile(const Tile& tile, const Planes& out, const Saved& saved) {
    Ray<level> ray[kBlocks];
    uint64_t rays = tile.inside();  // blocks with a ray that has not ended
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) ray[b].alive = tile.inside(b);
    for (int64_t k = tile.begin; k < tile.end; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local = K::Local::of(s, sx, sy);
        const Ints here = Ints{} + (int32_t)(k - tile.begin);
        uint64_t blended = 0;
        for (uint64_t todo = touched_blocks(s, sx, sy) & rays; todo; todo &= todo - 1) {
            const int bit = __builtin_ctzll(todo), b = block_at(bit);
            if (ray[b].template blend<K>(local, s, grid.x[b], grid.y[b], here)) blended |= 1ull << bit;
            if (!any(ray[b].alive)) rays &= ~(1ull << bit);
        }
        saved.blocks[k] = blended;
        if (!rays) break;
    }
    for (int b = 0; b < kBlocks; b++) {
        Ray<level>& r = ray[b];
        r.finish();
        const Floats alpha = 1.0f - r.open;
        tile.write(out.alpha, b, (const float*)&alpha);
        for (int c = 0; c < 3; c++) tile.write(out.color + c * tile.plane, b, (const float*)&r.color[c]);
        tile.write(saved.open, b, (const float*)&r.open);
        tile.write(saved.last, b, (const int32_t*)&r.last);
        if (level >= kGeometry) {
            tile.write(out.depth, b, (const float*)&r.depth);
            tile.write(out.median, b, (const float*)&r.median);
            tile.write(saved.middle, b, (const int32_t*)&r.middle);
            for (int c = 0; c < 3; c++) tile.write(out.normal + c * tile.plane, b, (const float*)&r.normal[c]);
        }
        if (level >= kDistortion) {
            tile.write(out.distortion, b, (const float*)&r.bend);
            tile.write(saved.m_shift, b, (const float*)&r.shift);
            tile.write(saved.m1, b, (const float*)&r.m1);
            tile.write(saved.m2, b, (const float*)&r.m2);
        }
    }
}

// ---- backward

// The cotangents of a block. Alpha is 1 - T: it acts through what is left open.
template <int level>
void read_cotangents(const Tile& tile, const Planes& p, Floats open, int b, Cotangents<level>& to) {
    for (int c = 0; c < 3; c++) to.color[c] = tile.read(p.color ? p.color + c * tile.plane : nullptr, b);
    to.behind = -(tile.read(p.alpha, b) * open);
    if (level >= kGeometry) {
        to.depth = tile.read(p.depth, b);
        to.median = tile.read(p.median, b);
        for (int c = 0; c < 3; c++) to.normal[c] = tile.read(p.normal ? p.normal + c * tile.plane : nullptr, b);
    }
    if (level >= kDistortion) to.bend = tile.read(p.distortion, b);
}

template <class K, int level, int chosen>
void backward_tile(const Tile& tile, const Planes& total_planes, const Planes& chosen_planes, const Saved& saved,
                   float* sums, uint8_t* touched_slots) {
    using Adder = typename AdderOf<K, level, chosen>::Type;
    Retrace<level, chosen> ray[kBlocks];
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) {
        Retrace<level, chosen>& r = ray[b];
        r.open = tile.read(saved.open, b);
        tile.read(saved.last, b, (int32_t*)&r.last);
        read_cotangents(tile, total_planes, r.open, b, r.total);
        if (chosen) read_cotangents(tile, chosen_planes, r.open, b, r.part);
        if (level >= kGeometry) tile.read(saved.middle, b, (int32_t*)&r.middle);
        if (level >= kDistortion) {
            r.all = 1.0f - r.open;
            r.shift = tile.read(saved.m_shift, b);
            r.m1 = tile.read(saved.m1, b);
            r.m2 = tile.read(saved.m2, b);
        }
    }
    for (int64_t k = tile.end - 1; k >= tile.begin; k--) {
        const uint64_t blended = saved.blocks[k];
        fetch<K, -8>(tile, k);
        if (!blended) continue;
        const bool fixed = tile.job.index[tile.job.entries[k].record] >= tile.job.rows;  // it only hides others
        float* const out = sums + (size_t)tile.job.entries[k].slot * Adder::width;
        if (!fixed)
            for (int i = 0; i < Adder::width; i += 16) __builtin_prefetch(out + i, 1);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local = K::Local::of(s, sx, sy);
        const Ints here = Ints{} + (int32_t)(k - tile.begin);
        const LocalSignal signal = LocalSignal::of({tile.job.width, tile.job.height}, s, sx, sy);
        Adder adder;
        for (uint64_t todo = blended; todo; todo &= todo - 1) {
            const int b = block_at(__builtin_ctzll(todo));
            ray[b].template step<K>(local, s, signal, grid.x[b], grid.y[b], here, fixed, adder);
        }
        if (fixed) continue;
        sum_lanes(adder.s, Adder::width, out);
        Adder::recentre(out, sx, sy);
        touched_slots[tile.job.entries[k].slot] = 1;
    }
}

// ---- contribution

template <class K>
void contribution_tile(const Tile& tile, float alpha_power, float open_power, float* sums, uint8_t* touched_slots) {
    const bool root_mean = alpha_power == 0.5f && open_power == 0.5f;
    Floats open[kBlocks];
    Mask alive[kBlocks];
    uint64_t rays = tile.inside();  // blocks with a ray that has not ended
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) {
        open[b] = broadcast(1.0f);
        alive[b] = tile.inside(b);
    }
    for (int64_t k = tile.begin; k < tile.end; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local = K::Local::of(s, sx, sy);
        Floats sum{};
        int count = 0;
        for (uint64_t todo = touched_blocks(s, sx, sy) & rays; todo; todo &= todo - 1) {
            const int bit = __builtin_ctzll(todo), b = block_at(bit);
            typename K::Pixel at;
            at.shape(local, grid.x[b], grid.y[b]);
            const Floats alpha = lower(local.opacity * exp_negative(-at.half_rho), broadcast(kAlphaMax));
            Mask m = less_equal(kAlphaMin, alpha) & alive[b];
            if (!any(m)) continue;
            const Floats before = open[b], after = before * (1.0f - alpha);
            const Mask ends = m & lesser(after, kTransmittanceMin);
            alive[b] = without(alive[b], ends);
            if (!any(alive[b])) rays &= ~(1ull << bit);
            m = without(m, ends);
            const Floats term =
                root_mean ? root(alpha * before)
                          : exp_negative(madd(log_positive(alpha), alpha_power, log_positive(before) * open_power));
            sum += keep(m, term);
            count += __builtin_popcount(bits(m));
            open[b] = select(m, after, before);
        }
        if (count) {
            const uint32_t slot = tile.job.entries[k].slot;
            float total = 0;
            for (int l = 0; l < kLanes; l++) total += sum[l];
            sums[2 * (size_t)slot] = total;
            sums[2 * (size_t)slot + 1] = (float)count;
            touched_slots[slot] = 1;
        }
        if (!rays) break;
    }
}

// ---- the leading splat of each pixel

// Adds one to the slot of the splat that has the largest weight of a pixel, where it is that of the median depth too.
// Of equal weights the first counts.
template <class K>
void leading_tile(const Tile& tile, uint32_t* counts) {
    Floats open[kBlocks], most[kBlocks] = {};
    Ints top[kBlocks], middle[kBlocks];
    Mask alive[kBlocks];
    uint64_t rays = tile.inside();  // blocks with a ray that has not ended
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) {
        open[b] = broadcast(1.0f);
        top[b] = middle[b] = Ints{} - 1;
        alive[b] = tile.inside(b);
    }
    for (int64_t k = tile.begin; k < tile.end && rays; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local = K::Local::of(s, sx, sy);
        const Ints here = Ints{} + (int32_t)(k - tile.begin);
        for (uint64_t todo = touched_blocks(s, sx, sy) & rays; todo; todo &= todo - 1) {
            const int bit = __builtin_ctzll(todo), b = block_at(bit);
            typename K::Pixel at;
            at.shape(local, grid.x[b], grid.y[b]);
            const Floats alpha = lower(local.opacity * exp_negative(-at.half_rho), broadcast(kAlphaMax));
            Mask m = less_equal(kAlphaMin, alpha) & alive[b];
            if (!any(m)) continue;
            const Floats before = open[b], after = before * (1.0f - alpha), w = alpha * before;
            const Mask ends = m & lesser(after, kTransmittanceMin);
            alive[b] = without(alive[b], ends);
            if (!any(alive[b])) rays &= ~(1ull << bit);
            m = without(m, ends);
            const Mask larger = m & lesser(most[b], w);
            most[b] = select(larger, w, most[b]);
            top[b] = select(larger, here, top[b]);
            middle[b] = select(m & lesser(0.5f, before), here, middle[b]);
            open[b] = select(m, after, before);
        }
    }
    for (int b = 0; b < kBlocks; b++) {  // the median exists where half of the light is stopped, as in `Ray::finish`
        const uint32_t both = bits(less_equal(open[b], broadcast(0.5f)) & equal(top[b], middle[b]));
        for (int l = 0; l < kLanes; l++)
            if (both >> l & 1) counts[tile.job.entries[tile.begin + top[b][l]].slot]++;
    }
}

// ---- opacity in front of points

template <class K>
void probe_tile(const Tile& tile, const Probes& probes) {
    for (int64_t k = tile.begin; k < tile.end; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const typename K::Local local = K::Local::of(s, tile.ox - s.ax, tile.oy - s.ay);
        for (int64_t g = 0; g < probes.count; g += kLanes) {
            if (probes.z[g + kLanes - 1] < s.z_low) continue;
            const Floats z = load(probes.z + g), open = load(probes.open + g);
            typename K::Pixel at;
            at.shape(local, load(probes.x + g), load(probes.y + g));
            const Floats alpha = lower(local.opacity * exp_negative(-at.half_rho), broadcast(kAlphaMax));
            Mask m = less_equal(kAlphaMin, alpha);
            if (!any(m)) continue;
            at.depth(local);
            m = m & less_equal(at.z, z);
            store(probes.open + g, open * (1.0f - keep(m, alpha)));
        }
    }
}

// The largest density of each ellipsoid between `near` and the points on their rays. With the ray t r from the camera
// o, it is that at t* = -o.r / r.r or, where t* lies outside, at the nearer end; |o x r|^2 / r.r is the squared
// distance of the line from the centre, which does not cancel as o.o - (o.r)^2 / r.r would.
//
// As stochastic solids (GGGS, eq. 12) they leave open sqrt(1 - G) up to t*, with the density G at the point, and
// (1 - G*) / sqrt(1 - G) behind it. G counts from kAlphaMin on, so that behind the contour 1 - G* is left as in pictures.
template <bool solid>
void ray_probe_of(const RaySplat* splats, const uint32_t* rows, int64_t count, double ox, double oy, float near,
                  const Probes& probes) {
    for (int64_t k = 0; k < count; k++) {
        const RaySplat& s = splats[rows[k]];
        double at[3][3], cross[3][3];  // by x, by y, at the centre
        for (int i = 0; i < 3; i++) {
            at[0][i] = s.r[0][i];
            at[1][i] = s.r[1][i];
            at[2][i] = s.r[2][i] + ox * s.r[0][i] + oy * s.r[1][i];
        }
        for (int j = 0; j < 3; j++)
            for (int i = 0; i < 3; i++)
                cross[j][i] = s.o[(i + 1) % 3] * at[j][(i + 2) % 3] - s.o[(i + 2) % 3] * at[j][(i + 1) % 3];
        for (int64_t g = 0; g < probes.count; g += kLanes) {
            if (probes.z[g + kLanes - 1] < s.z_low) continue;
            const Floats x = load(probes.x + g), y = load(probes.y + g), z = load(probes.z + g);
            Floats length{}, aside{}, along{};
            for (int i = 0; i < 3; i++) {
                const Floats r = madd(x, (float)at[0][i], madd(y, (float)at[1][i], broadcast((float)at[2][i])));
                const Floats m =
                    madd(x, (float)cross[0][i], madd(y, (float)cross[1][i], broadcast((float)cross[2][i])));
                length = madd(r, r, length);
                aside = madd(m, m, aside);
                along = madd(r, (float)-s.o[i], along);
            }
            const Floats peak = along / length, line = aside / length;
            const auto alpha_at = [&](Floats t) {
                const Floats off = t - peak, rho = madd(length * off, off, line);
                const Floats half_rho = 0.5f * (solid ? lower(rho, broadcast(100.0f)) : rho);  // points may be far off
                return lower(s.opacity * exp_negative(-half_rho), broadcast(kAlphaMax));
            };
            const Floats first = solid ? peak : lower(peak, z), t = higher(first, broadcast(near));
            const Floats alpha = alpha_at(t);
            const Mask m = less_equal(kAlphaMin, alpha);
            if (!any(m)) continue;
            Floats open = 1.0f - keep(m, alpha);
            if (solid) {
                const Floats here = alpha_at(z), vacancy = root(1.0f - keep(less_equal(kAlphaMin, here) & m, here));
                open = select(lesser(t, z), open / vacancy, vacancy);
            }
            store(probes.open + g, load(probes.open + g) * open);
        }
    }
}

void ray_probe(bool solid, const RaySplat* splats, const uint32_t* rows, int64_t count, double ox, double oy,
               float near, const Probes& probes) {
    (solid ? ray_probe_of<true> : ray_probe_of<false>)(splats, rows, count, ox, oy, near, probes);
}

// ---- dispatch

template <class K>
void forward_of(Level level, const Tile& tile, const Planes& out, const Saved& saved) {
    switch (level) {
        case kColor:
            return forward_tile<K, kColor>(tile, out, saved);
        case kGeometry:
            return forward_tile<K, kGeometry>(tile, out, saved);
        case kDistortion:
            return forward_tile<K, kDistortion>(tile, out, saved);
    }
}
template <class K, int level>
void backward_of(Chosen chosen, const Tile& tile, const Planes& a, const Planes& b, const Saved& saved, float* sums,
                 uint8_t* touched) {
    switch (chosen) {
        case kNone:
            return backward_tile<K, level, kNone>(tile, a, b, saved, sums, touched);
        case kChosenColor:
            return backward_tile<K, level, kChosenColor>(tile, a, b, saved, sums, touched);
        case kChosenAll:
            return backward_tile<K, level, kChosenAll>(tile, a, b, saved, sums, touched);
        case kChosenAbsolute:
            return backward_tile<K, level, kChosenAbsolute>(tile, a, b, saved, sums, touched);
    }
}
template <class K>
void backward_of(Level level, Chosen chosen, const Tile& tile, const Planes& a, const Planes& b, const Saved& saved,
                 float* sums, uint8_t* touched) {
    switch (level) {
        case kColor:
            return backward_of<K, kColor>(chosen, tile, a, b, saved, sums, touched);
        case kGeometry:
            return backward_of<K, kGeometry>(chosen, tile, a, b, saved, sums, touched);
        case kDistortion:
            return backward_of<K, kDistortion>(chosen, tile, a, b, saved, sums, touched);
    }
}

// Calls f with the type of a kind.
template <class F>
void of_kind(Kind kind, F f) {
    switch (kind) {
        case kSurfel:
            return f(Surfels{});
        case kGaussian:
            return f(Gaussians{});
        case kGaussianRay:
            return f(Rays{});
    }
}
void forward(Kind kind, Level level, const Job& job, int64_t tile, const Planes& out, const Saved& saved) {
    of_kind(kind, [&](auto k) { forward_of<decltype(k)>(level, Tile(job, tile), out, saved); });
}
void backward(Kind kind, Level level, Chosen chosen, const Job& job, int64_t tile, const Planes& a, const Planes& b,
              const Saved& saved, float* sums, uint8_t* touched) {
    if (job.offsets[tile] == job.offsets[tile + 1]) return;
    of_kind(kind,
            [&](auto k) { backward_of<decltype(k)>(level, chosen, Tile(job, tile), a, b, saved, sums, touched); });
}
void contribution(Kind kind, const Job& job, int64_t tile, float alpha_power, float open_power, float* sums,
                  uint8_t* touched) {
    of_kind(kind,
            [&](auto k) { contribution_tile<decltype(k)>(Tile(job, tile), alpha_power, open_power, sums, touched); });
}

void solid(const Job& job, int64_t tile, float near, const Planes& out, const Saved& saved) {
    solid_tile(Tile(job, tile), near, out, saved);
}
void solid_backward(Chosen chosen, const Job& job, int64_t tile, const Planes& a, const Planes& b, const Saved& saved,
                    float* sums, uint8_t* touched) {
    switch (chosen) {
        case kNone:
            return solid_backward_tile<kNone>(Tile(job, tile), a, b, saved, sums, touched);
        case kChosenColor:
            return solid_backward_tile<kChosenColor>(Tile(job, tile), a, b, saved, sums, touched);
        case kChosenAll:
            return solid_backward_tile<kChosenAll>(Tile(job, tile), a, b, saved, sums, touched);
        case kChosenAbsolute:
            return solid_backward_tile<kChosenAbsolute>(Tile(job, tile), a, b, saved, sums, touched);
    }
}

void leading(Kind kind, const Job& job, int64_t tile, uint32_t* counts) {
    of_kind(kind, [&](auto k) { leading_tile<decltype(k)>(Tile(job, tile), counts); });
}

int tiles(const splat::Bound<double>& bound, int tiles_x, int tiles_y, double rim, uint32_t* to) {
    int count = 0;
    each_tile(bound, splat::outline(bound), 0.0, 0.0, tiles_x, tiles_y, rim, [&](int tile) { to[count++] = (uint32_t)tile; });
    return count;
}

bool add_rows(const float* rows, const uint8_t* touched, int64_t count, int width, double* sums) {
    bool some = false;
    for (int64_t k = 0; k < count; k++) {
        if (!touched[k]) continue;
        for (int i = 0; i < width; i += 4)
            for (int j = i; j < i + 4; j++) sums[j] += rows[k * width + j];
        some = true;
    }
    return some;
}

void probe(Kind kind, const Job& job, int64_t tile, const Probes& probes) {
    of_kind(kind, [&](auto k) { probe_tile<decltype(k)>(Tile(job, tile), probes); });
}

}  // namespace

#define SURFKIT_NAME_(x) #x
#define SURFKIT_NAME(x) SURFKIT_NAME_(x)
#define SURFKIT_TABLE_(x) kernels_##x
#define SURFKIT_TABLE(x) SURFKIT_TABLE_(x)
const Kernels& SURFKIT_TABLE(SURFKIT_KERNELS)() {
    static const Kernels table{SURFKIT_NAME(SURFKIT_KERNELS),
                               forward,
                               backward,
                               solid,
                               solid_backward,
                               contribution,
                               leading,
                               probe,
                               ray_probe,
                               ssim_rows,
                               ssim_gradient_rows,
                               normal_rows,
                               project_surfels,
                               surfels_backward,
                               tiles,
                               shade_some,
                               shade_some_backward,
                               add_rows,
                               adam,
                               adam_rows,
                               adam_short};
    return table;
}

}  // namespace surfkit
