// The per-pixel kernels. Compiled three times (AVX-512, AVX2, baseline) with SURFKIT_KERNELS naming the table to
// define.
//
// A tile of 16 x 16 pixels is cut into blocks of 4 x (lanes / 4), one vector each. For each splat the rows of its
// footprint tell which blocks it can touch; blocks whose rays have all ended are left out.
#include "../../native/simd.h"

#define SPLAT_FN static inline
#include "../splat_math.h"
#include "kernels.h"
#include "images.h"

namespace surfkit {
namespace {

using splat::kAlphaMax;
using splat::kAlphaMin;
using splat::kTransmittanceMin;

constexpr int kBlockRows = kLanes / 4;  // pixel rows in a block
constexpr int kBlocksDown = kTile / kBlockRows;
constexpr int kBlocks = 4 * kBlocksDown;
constexpr float kMiddle = (kTile - 1) / 2.0f;
constexpr uint64_t kRowBits = 0x0001000100010001ull * (kBlockRows == 4 ? 0x1111 : kBlockRows == 2 ? 0x5555 : 0xffff);

// Pixel centres of a block about the tile's centre, where they are smallest and so most exact in a product.
struct Lanes {
    Floats x[kBlocks], y[kBlocks];
    Floats count[kTile / kLanes];
    Lanes() {
        for (int b = 0; b < kBlocks; b++)
            for (int l = 0; l < kLanes; l++) {
                x[b][l] = (float)(b / kBlocksDown * 4 + l % 4) - kMiddle;
                y[b][l] = (float)(b % kBlocksDown * kBlockRows + l / 4) - kMiddle;
            }
        for (int i = 0; i < kTile; i++) count[i / kLanes][i % kLanes] = (float)i - kMiddle;
    }
};
const Lanes& lanes() {
    static const Lanes table;
    return table;
}

// One tile of an image: where its blocks lie in memory.
struct Tile {
    const Job& job;
    int x0, y0;
    float ox, oy;  // the centre
    size_t plane;
    int64_t begin, end;

    Tile(const Job& j, int64_t index)
        : job(j),
          x0((int)(index % j.tiles_x) * kTile),
          y0((int)(index / j.tiles_x) * kTile),
          ox(x0 + kTile / 2.0f),
          oy(y0 + kTile / 2.0f),
          plane((size_t)j.width * j.height),
          begin(j.offsets[index]),
          end(j.offsets[index + 1]) {}

    template <class T>
    void read(const T* from, int block, T* to) const {
        each_row(block, [&](size_t at, int lane, int n) { std::memcpy(to + lane, from + at, n * sizeof(T)); });
    }
    template <class T>
    void write(T* to, int block, const T* from) const {
        each_row(block, [&](size_t at, int lane, int n) { std::memcpy(to + at, from + lane, n * sizeof(T)); });
    }
    Floats read(const float* from, int block) const {
        Floats v{};
        if (from) read(from, block, (float*)&v);
        return v;
    }
    // The blocks with a pixel inside the image, as bits of `touched_blocks`.
    uint64_t inside() const {
        const int rows = job.height - y0 < kTile ? job.height - y0 : kTile;
        uint64_t in = 0;
        for (int j = 0; j < 4; j++)
            if (x0 + 4 * j < job.width) in |= ((1ull << rows) - 1) << (16 * j);
        return in & kRowBits;
    }
    Mask inside(int block) const {
        int32_t on[kLanes] = {};
        each_row(block, [&](size_t, int lane, int n) {
            for (int i = 0; i < n; i++) on[lane + i] = 1;
        });
        Ints v;
        std::memcpy(&v, on, sizeof v);
        return equal(v, Ints{} + 1);
    }

  private:
    template <class F>
    SURFKIT_INLINE void each_row(int block, F f) const {
        const int x = x0 + block / kBlocksDown * 4, y = y0 + block % kBlocksDown * kBlockRows;
        const int n = job.width - x < 4 ? job.width - x : 4;
        if (n == 4 && y + kBlockRows <= job.height) {
            for (int r = 0; r < kBlockRows; r++) f((size_t)(y + r) * job.width + x, 4 * r, 4);
            return;
        }
        if (n <= 0) return;
        for (int r = 0; r < kBlockRows && y + r < job.height; r++) f((size_t)(y + r) * job.width + x, 4 * r, n);
    }
};

// The blocks a record's footprint touches, bit 16 * column + row of pixels. (sx, sy): the tile's centre less the
// anchor.
template <class Record>
SURFKIT_INLINE uint64_t touched_blocks(const Record& s, float sx, float sy) {
    const Lanes& grid = lanes();
    const Floats far = broadcast(1e30f), tiny = broadcast(1e-20f);
    const float more = 1.0005f;  // the roots are rough
    uint64_t hit = 0;
    for (int v = 0; v < kTile / kLanes; v++) {
        const Floats y = grid.count[v] + sy;
        const Floats dy = y - s.my, left = madd(dy * dy, -s.flat, broadcast(1.0f));
        const Floats half = rough_root(higher(left * (s.wide * more), tiny)),
                     mid = madd(dy, s.tilt, broadcast(s.mx - sx));
        const Mask on = less_equal(0.0f, left);
        Floats low = select(on, mid - half, far), high = select(on, mid + half, -far);
        if (s.disc_r2 > 0) {
            const Floats dd = y - s.disc_y, rest = s.disc_r2 - dd * dd;
            const Floats reach = rough_root(higher(rest * more, tiny));
            const Mask disc = less_equal(0.0f, rest);
            low = lower(low, select(disc, (s.disc_x - sx) - reach, far));
            high = higher(high, select(disc, (s.disc_x - sx) + reach, -far));
        }
        for (int j = 0; j < 4; j++)
            hit |= (uint64_t)bits(less_equal(low, 4.0f * j + 3 - kMiddle) & less_equal(4.0f * j - kMiddle, high))
                   << (16 * j + v * kLanes);
    }
    if (kBlockRows > 1) hit |= hit >> 1;
    if (kBlockRows > 2) hit |= hit >> 2;
    return hit & kRowBits;
}
inline int block_at(int bit) { return bit / 16 * kBlocksDown + bit % 16 / kBlockRows; }

// ---- the two kinds, at pixels of one tile

struct LocalSurfel {
    float a[3], b[3], c[3], det, low_x, low_y, z_low, z_high, opacity;
    SURFKIT_INLINE LocalSurfel(const SurfelRecord& s, float sx, float sy)
        : det(s.det), low_x(s.disc_x - sx), low_y(s.disc_y - sy), z_low(s.z_low), z_high(s.z_high), opacity(s.opacity) {
        for (int i = 0; i < 3; i++) {
            a[i] = (float)s.a[i];
            b[i] = (float)s.b[i];
            c[i] = (float)(s.c[i] + sx * s.a[i] + sy * s.b[i]);
        }
    }
};
struct LocalGaussian {
    float x, y, l00, l01, l11, z, slope_x, slope_y, z_low, z_high, opacity;
    SURFKIT_INLINE LocalGaussian(const GaussianRecord& s, float sx, float sy)
        : x(s.x - sx),
          y(s.y - sy),
          l00(s.l00),
          l01(s.l01),
          l11(s.l11),
          z(s.z),
          slope_x(s.slope_x),
          slope_y(s.slope_y),
          z_low(s.z_low),
          z_high(s.z_high),
          opacity(s.opacity) {}
};

struct SurfelPixel {
    splat::SurfelHit<Floats> hit;
    Mask on_disc, free_z;
    Floats half_rho, z;
    inline void shape(const LocalSurfel& s, Floats x, Floats y) {
        hit = splat::surfel_hit<Floats>(s, x, y, on_disc);
        half_rho = 0.5f * hit.rho;
    }
    inline void depth(const LocalSurfel& s) { z = splat::surfel_depth<Floats>(s, hit, free_z); }
};
struct GaussianPixel {
    Floats dx, dy;
    Mask free_z;
    Floats half_rho, z;
    inline void shape(const LocalGaussian& s, Floats x, Floats y) {
        dx = x - s.x;
        dy = y - s.y;
        const Floats p = madd(dx, s.l00, dy * s.l01), q = dy * s.l11;
        half_rho = 0.5f * madd(p, p, q * q);
    }
    inline void depth(const LocalGaussian& s) {
        const Floats plane = madd(dx, s.slope_x, madd(dy, s.slope_y, broadcast(s.z)));
        free_z = less_equal(s.z_low, plane) & less_equal(plane, s.z_high);
        z = select(free_z, plane, select(less_equal(s.z_high, plane), s.z_high, s.z_low));
    }
};

// A splat::SignalRow about the tile's centre.
struct LocalSignal {
    float x[6], y[6];
    SURFKIT_INLINE LocalSignal(const Job& job, const SurfelRecord& s, float sx, float sy) {
        const float side = (float)job.height / (float)job.width, *const f = s.signal_x, *const g = s.signal_y;
        const float x_[6] = {f[0], f[1] + sy * f[0], f[2], f[3] + sy * f[2], f[4], f[5]};
        const float y_[6] = {-side * f[0], g[0] - sx * side * f[0], -side * f[2], g[1] - sx * side * f[2], g[2],
                             side * f[5]};
        std::memcpy(x, x_, sizeof x);
        std::memcpy(y, y_, sizeof y);
    }
    SURFKIT_INLINE LocalSignal(const Job& job, const GaussianRecord& s, float, float) : x{}, y{} {
        const float half_w = 0.5f * (float)job.width, half_h = 0.5f * (float)job.height, cross = s.l00 * s.l01;
        x[0] = half_w * s.l00 * s.l00;
        x[1] = half_w * cross;
        x[2] = -half_w * s.slope_x;
        y[0] = half_h * cross;
        y[1] = half_h * (s.l01 * s.l01 + s.l11 * s.l11);
        y[2] = -half_h * s.slope_y;
    }
};

struct Surfels {
    using Record = SurfelRecord;
    using Local = LocalSurfel;
    using Pixel = SurfelPixel;
    static constexpr int sums = kSurfelSums, sums_chosen = kSurfelSumsChosen;
};
struct Gaussians {
    using Record = GaussianRecord;
    using Local = LocalGaussian;
    using Pixel = GaussianPixel;
    static constexpr int sums = kGaussianSums, sums_chosen = kGaussianSumsChosen;
};

// Fetches into the cache what the entry `ahead` of k will need: records lie in the order of the splats, not of the
// tile.
template <class K, int ahead>
SURFKIT_INLINE void fetch(const Tile& tile, int64_t k) {
    const int64_t next = k + ahead;
    if (next < tile.begin || next >= tile.end) return;
    const char* at = (const char*)((const typename K::Record*)tile.job.records + tile.job.entries[next].record);
    for (size_t line = 0; line < sizeof(typename K::Record); line += 64) __builtin_prefetch(at + line);
}
template <class K>
inline const typename K::Record& record_of(const Tile& tile, int64_t k) {
    return ((const typename K::Record*)tile.job.records)[tile.job.entries[k].record];
}

// ---- forward

template <class K, int level>
void forward_tile(const Tile& tile, const Planes& out, const Saved& saved) {
    Floats open[kBlocks], color[3][kBlocks], depth[kBlocks], median[kBlocks], normal[3][kBlocks];
    Floats bend[kBlocks], shift[kBlocks], m1[kBlocks], m2[kBlocks];
    Ints last[kBlocks], middle[kBlocks];
    Mask alive[kBlocks];
    uint64_t rays = tile.inside();  // blocks with a ray that has not ended
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) {
        open[b] = broadcast(1.0f);
        color[0][b] = color[1][b] = color[2][b] = depth[b] = median[b] = normal[0][b] = normal[1][b] = normal[2][b] =
            Floats{};
        bend[b] = shift[b] = m1[b] = m2[b] = Floats{};
        last[b] = middle[b] = Ints{} - 1;
        alive[b] = tile.inside(b);
    }
    for (int64_t k = tile.begin; k < tile.end; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local(s, sx, sy);
        const Ints here = Ints{} + (int32_t)(k - tile.begin);
        uint64_t blended = 0;
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
            blended |= (uint64_t)any(m) << bit;
            const Floats w = keep(m, alpha * before);
            for (int c = 0; c < 3; c++) color[c][b] = madd(w, s.color[c], color[c][b]);
            if (level >= kGeometry) {
                at.depth(local);
                depth[b] = madd(w, at.z, depth[b]);
                for (int c = 0; c < 3; c++) normal[c][b] = madd(w, s.normal[c], normal[c][b]);
                const Mask half = m & lesser(0.5f, before);
                median[b] = select(half, at.z, median[b]);
                middle[b] = select(half, here, middle[b]);
            }
            if (level >= kDistortion) {
                const Floats m_z = reciprocal(at.z);
                shift[b] = select(m & equal(last[b], Ints{} - 1), m_z, shift[b]);
                const Floats d = m_z - shift[b], wd = w * d;
                bend[b] = bend[b] + w * madd(d * d, 1.0f - before, m2[b] - 2.0f * d * m1[b]);
                m1[b] = m1[b] + wd;
                m2[b] = madd(wd, d, m2[b]);
            }
            open[b] = select(m, after, before);
            last[b] = select(m, here, last[b]);
        }
        saved.blocks[k] = blended;
        if (!rays) break;
    }
    for (int b = 0; b < kBlocks; b++) {
        const Floats alpha = 1.0f - open[b];
        tile.write(out.alpha, b, (const float*)&alpha);
        for (int c = 0; c < 3; c++) tile.write(out.color + c * tile.plane, b, (const float*)&color[c][b]);
        tile.write(saved.open, b, (const float*)&open[b]);
        tile.write(saved.last, b, (const int32_t*)&last[b]);
        if (level >= kGeometry) {
            const Mask opaque = less_equal(open[b], 0.5f);
            median[b] = keep(opaque, median[b]);
            middle[b] = select(opaque, middle[b], Ints{} - 1);
            tile.write(out.depth, b, (const float*)&depth[b]);
            tile.write(out.median, b, (const float*)&median[b]);
            tile.write(saved.middle, b, (const int32_t*)&middle[b]);
            for (int c = 0; c < 3; c++) tile.write(out.normal + c * tile.plane, b, (const float*)&normal[c][b]);
        }
        if (level >= kDistortion) {
            tile.write(out.distortion, b, (const float*)&bend[b]);
            tile.write(saved.m_shift, b, (const float*)&shift[b]);
            tile.write(saved.m1, b, (const float*)&m1[b]);
            tile.write(saved.m2, b, (const float*)&m2[b]);
        }
    }
}

// ---- backward

// The cotangents of one group of losses over a tile, and the running sum of what lies behind.
template <int level>
struct Cotangents {
    Floats color[3][kBlocks], depth[kBlocks], median[kBlocks], normal[3][kBlocks], bend[kBlocks], behind[kBlocks];

    void read(const Tile& tile, const Planes& p, const Floats* open, int b) {
        for (int c = 0; c < 3; c++) color[c][b] = tile.read(p.color ? p.color + c * tile.plane : nullptr, b);
        behind[b] = -(tile.read(p.alpha, b) * open[b]);  // alpha = 1 - T: it acts through what is left open
        if (level >= kGeometry) {
            depth[b] = tile.read(p.depth, b);
            median[b] = tile.read(p.median, b);
            for (int c = 0; c < 3; c++) normal[c][b] = tile.read(p.normal ? p.normal + c * tile.plane : nullptr, b);
        }
        if (level >= kDistortion) bend[b] = tile.read(p.distortion, b);
    }
    // dL/d(weight) of a splat with inverse depth d about the shift.
    template <class Record>
    inline Floats per_weight(const Record& s, int b, Floats z, Floats d, Floats all, Floats m1, Floats m2) const {
        Floats dot = madd(color[0][b], s.color[0], madd(color[1][b], s.color[1], color[2][b] * s.color[2]));
        if (level >= kGeometry) {
            dot =
                madd(normal[0][b], s.normal[0], madd(normal[1][b], s.normal[1], madd(normal[2][b], s.normal[2], dot)));
            dot = madd(depth[b], z, dot);
        }
        if (level >= kDistortion) dot = madd(bend[b], madd(d * d, all, m2 - 2.0f * d * m1), dot);
        return dot;
    }
    // dL/dz of a splat with weight w, where it is the median's (`mid`) or not.
    inline Floats per_depth(int b, Floats w, Mask mid, Floats m_z, Floats d, Floats all, Floats m1) const {
        Floats g = madd(w, depth[b], keep(mid, median[b]));
        if (level >= kDistortion) g = g - 2.0f * bend[b] * w * madd(d, all, -m1) * (m_z * m_z);
        return g;
    }
};

// Sums over the pixels of a tile for one splat; the order is that of the structs in splat_math.h.
template <int level, int chosen>
struct SurfelAdder {
    Floats s[chosen ? kSurfelSumsChosen : kSurfelSums] = {};
    inline void add(const SurfelPixel& at, Floats x, Floats y, Mask m, Floats e, Floats dz) {
        const Mask disc = at.on_disc & m;
        const Floats ei = e * at.hit.inv;
        const Floats q0 = keep(disc, ei * at.hit.u), q1 = keep(disc, ei * at.hit.v);
        Floats q2 = keep(disc, -madd(q0, at.hit.u, q1 * at.hit.v));
        if (level >= kGeometry) {
            const Floats t = keep(at.free_z & m, dz * at.hit.inv);
            s[9] += t;
            q2 = madd(-t, at.z, q2);
        }
        s[0] = madd(q0, x, s[0]);
        s[1] = madd(q1, x, s[1]);
        s[2] = madd(q2, x, s[2]);
        s[3] = madd(q0, y, s[3]);
        s[4] = madd(q1, y, s[4]);
        s[5] = madd(q2, y, s[5]);
        s[6] += q0;
        s[7] += q1;
        s[8] += q2;
        const Floats f = keep(without(m, at.on_disc), -2.0f * e);
        s[10] = madd(f, at.hit.dx, s[10]);
        s[11] = madd(f, at.hit.dy, s[11]);
    }
    // The pixel's share of the chosen signal; `e` is 0 where nothing was blended.
    inline void add_chosen(const SurfelPixel& at, const LocalSignal& f, Floats x, Floats y, Mask m, Floats e,
                           Floats dz) {
        const Mask disc = at.on_disc & m;
        const Floats u = at.hit.inv * at.hit.u, v = at.hit.inv * at.hit.v;
        const Floats hx = madd(u, madd(y, f.x[0], broadcast(f.x[1])), v * madd(y, f.x[2], broadcast(f.x[3])));
        const Floats hy = madd(u, madd(x, f.y[0], broadcast(f.y[1])), v * madd(x, f.y[2], broadcast(f.y[3])));
        Floats gx = e * select(disc, hx, at.hit.dx * f.x[5]), gy = e * select(disc, hy, at.hit.dy * f.y[5]);
        if (chosen != kChosenColor && level >= kGeometry) {
            const Floats t = keep(at.free_z & m, dz * at.hit.inv);
            gx = madd(t, f.x[4], gx);
            gy = madd(t, f.y[4], gy);
        }
        s[20] += chosen == kChosenAbsolute ? magnitude(gx) : gx;
        s[21] += chosen == kChosenAbsolute ? magnitude(gy) : gy;
    }
    inline void add_normal(int c, Floats v) { s[12 + c] += v; }
    inline void add_opacity(Floats v) { s[15] += v; }
    inline void add_color(int c, Floats v) { s[16 + c] += v; }
    // From sums about the tile's origin to sums about the anchor.
    void finish(float sx, float sy, float* out) const {
        sum_lanes(s, chosen ? kSurfelSumsChosen : kSurfelSums, out);
        for (int i = 0; i < 3; i++) {
            out[i] += sx * out[6 + i];
            out[3 + i] += sy * out[6 + i];
        }
    }
};
template <int level, int chosen>
struct GaussianAdder {
    Floats s[chosen ? kGaussianSumsChosen : kGaussianSums] = {};
    // `e` is dL/d(rho / 2); the moments are of dL/d(power) = -e.
    inline void add(const GaussianPixel& at, Floats, Floats, Mask m, Floats e, Floats dz) {
        const Floats gx = -(e * at.dx), gy = -(e * at.dy);
        s[0] += gx;
        s[1] += gy;
        s[2] = madd(gx, at.dx, s[2]);
        s[3] = madd(gx, at.dy, s[3]);
        s[4] = madd(gy, at.dy, s[4]);
        if (level >= kGeometry) {
            const Floats t = keep(at.free_z & m, dz);
            s[5] += t;
            s[6] = madd(t, at.dx, s[6]);
            s[7] = madd(t, at.dy, s[7]);
        }
    }
    inline void add_chosen(const GaussianPixel& at, const LocalSignal& f, Floats, Floats, Mask m, Floats e, Floats dz) {
        Floats gx = -e * madd(at.dx, f.x[0], at.dy * f.x[1]), gy = -e * madd(at.dx, f.y[0], at.dy * f.y[1]);
        if (chosen != kChosenColor && level >= kGeometry) {
            const Floats t = keep(at.free_z & m, dz);
            gx = madd(t, f.x[2], gx);
            gy = madd(t, f.y[2], gy);
        }
        s[16] += chosen == kChosenAbsolute ? magnitude(gx) : gx;
        s[17] += chosen == kChosenAbsolute ? magnitude(gy) : gy;
    }
    inline void add_normal(int c, Floats v) { s[8 + c] += v; }
    inline void add_opacity(Floats v) { s[11] += v; }
    inline void add_color(int c, Floats v) { s[12 + c] += v; }
    void finish(float, float, float* out) const { sum_lanes(s, chosen ? kGaussianSumsChosen : kGaussianSums, out); }
};
template <class K, int level, int chosen>
struct AdderOf {
    using Type = SurfelAdder<level, chosen>;
};
template <int level, int chosen>
struct AdderOf<Gaussians, level, chosen> {
    using Type = GaussianAdder<level, chosen>;
};

template <class K, int level, int chosen>
void backward_tile(const Tile& tile, const Planes& total_planes, const Planes& chosen_planes, const Saved& saved,
                   float* sums, uint8_t* touched_slots) {
    constexpr int width = chosen ? K::sums_chosen : K::sums;
    constexpr int chosen_level = chosen == kChosenAll || chosen == kChosenAbsolute ? level : kColor;
    Floats open[kBlocks], all[kBlocks], shift[kBlocks], m1[kBlocks], m2[kBlocks];
    Ints last[kBlocks], middle[kBlocks];
    Cotangents<level> total;
    Cotangents<chosen_level> part;
    const Lanes& grid = lanes();
    for (int b = 0; b < kBlocks; b++) {
        open[b] = tile.read(saved.open, b);
        last[b] = middle[b] = Ints{} - 1;
        tile.read(saved.last, b, (int32_t*)&last[b]);
        total.read(tile, total_planes, open, b);
        if (chosen) part.read(tile, chosen_planes, open, b);
        if (level >= kGeometry) tile.read(saved.middle, b, (int32_t*)&middle[b]);
        if (level >= kDistortion) {
            all[b] = 1.0f - open[b];
            shift[b] = tile.read(saved.m_shift, b);
            m1[b] = tile.read(saved.m1, b);
            m2[b] = tile.read(saved.m2, b);
        }
    }
    for (int64_t k = tile.end - 1; k >= tile.begin; k--) {
        const uint64_t blended = saved.blocks[k];
        fetch<K, -8>(tile, k);
        if (!blended) continue;
        const bool fixed = tile.job.index[tile.job.entries[k].record] >= tile.job.rows;  // it only hides others
        float* const out = sums + (size_t)tile.job.entries[k].slot * width;
        if (!fixed)
            for (int i = 0; i < width; i += 16) __builtin_prefetch(out + i, 1);
        const auto& s = record_of<K>(tile, k);
        const float sx = tile.ox - s.ax, sy = tile.oy - s.ay;
        const typename K::Local local(s, sx, sy);
        const Ints here = Ints{} + (int32_t)(k - tile.begin);
        const LocalSignal signal(tile.job, s, sx, sy);
        typename AdderOf<K, level, chosen>::Type adder;
        for (uint64_t todo = blended; todo; todo &= todo - 1) {
            const int b = block_at(__builtin_ctzll(todo));
            const Floats x = grid.x[b], y = grid.y[b];
            typename K::Pixel at;
            at.shape(local, x, y);
            const Floats fall = exp_negative(-at.half_rho), raw = local.opacity * fall;
            const Floats alpha = lower(raw, broadcast(kAlphaMax));
            const Mask m = less_equal(kAlphaMin, alpha) & less_equal(here, last[b]);
            const Floats ra = reciprocal(1.0f - alpha), before = open[b] * ra, w = keep(m, alpha * before);
            open[b] = select(m, before, open[b]);
            Floats m_z{}, d{}, z{};
            if (level >= kGeometry) {
                at.depth(local);
                z = at.z;
            }
            if (level >= kDistortion) {
                m_z = reciprocal(z);
                d = m_z - shift[b];
            }
            const Floats per_weight = total.per_weight(s, b, z, d, all[b], m1[b], m2[b]);
            if (fixed) {
                total.behind[b] = madd(w, per_weight, total.behind[b]);
                if (chosen)
                    part.behind[b] = madd(w, part.per_weight(s, b, z, d, all[b], m1[b], m2[b]), part.behind[b]);
                continue;
            }
            const Mask smooth = m & lesser(raw, kAlphaMax);
            const Floats da = keep(smooth, before * per_weight - total.behind[b] * ra);
            total.behind[b] = madd(w, per_weight, total.behind[b]);
            adder.add_opacity(da * fall);
            for (int c = 0; c < 3; c++) adder.add_color(c, w * total.color[c][b]);
            Floats dz{};
            Mask mid = m;
            if (level >= kGeometry) {
                mid = m & equal(here, middle[b]);
                dz = total.per_depth(b, w, mid, m_z, d, all[b], m1[b]);
                for (int c = 0; c < 3; c++) adder.add_normal(c, w * total.normal[c][b]);
            }
            adder.add(at, x, y, m, -(da * raw), dz);
            if (chosen) {
                const Floats pw = part.per_weight(s, b, z, d, all[b], m1[b], m2[b]);
                const Floats pa = keep(smooth, before * pw - part.behind[b] * ra);
                part.behind[b] = madd(w, pw, part.behind[b]);
                Floats pz{};
                if (chosen_level >= kGeometry) pz = part.per_depth(b, w, mid, m_z, d, all[b], m1[b]);
                adder.add_chosen(at, signal, x, y, m, -(pa * raw), pz);
            }
        }
        if (fixed) continue;
        const uint32_t slot = tile.job.entries[k].slot;
        float row[width];
        adder.finish(sx, sy, row);
        std::memcpy(out, row, sizeof row);
        touched_slots[slot] = 1;
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
        const typename K::Local local(s, sx, sy);
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

// ---- opacity in front of points

template <class K>
void probe_tile(const Tile& tile, const Probes& probes) {
    for (int64_t k = tile.begin; k < tile.end; k++) {
        fetch<K, 8>(tile, k);
        const auto& s = record_of<K>(tile, k);
        const typename K::Local local(s, tile.ox - s.ax, tile.oy - s.ay);
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

void forward(Kind kind, Level level, const Job& job, int64_t tile, const Planes& out, const Saved& saved) {
    kind == kSurfel ? forward_of<Surfels>(level, Tile(job, tile), out, saved)
                    : forward_of<Gaussians>(level, Tile(job, tile), out, saved);
}
void backward(Kind kind, Level level, Chosen chosen, const Job& job, int64_t tile, const Planes& a, const Planes& b,
              const Saved& saved, float* sums, uint8_t* touched) {
    if (job.offsets[tile] == job.offsets[tile + 1]) return;
    kind == kSurfel ? backward_of<Surfels>(level, chosen, Tile(job, tile), a, b, saved, sums, touched)
                    : backward_of<Gaussians>(level, chosen, Tile(job, tile), a, b, saved, sums, touched);
}
void contribution(Kind kind, const Job& job, int64_t tile, float alpha_power, float open_power, float* sums,
                  uint8_t* touched) {
    kind == kSurfel ? contribution_tile<Surfels>(Tile(job, tile), alpha_power, open_power, sums, touched)
                    : contribution_tile<Gaussians>(Tile(job, tile), alpha_power, open_power, sums, touched);
}

void probe(Kind kind, const Job& job, int64_t tile, const Probes& probes) {
    kind == kSurfel ? probe_tile<Surfels>(Tile(job, tile), probes) : probe_tile<Gaussians>(Tile(job, tile), probes);
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
                               contribution,
                               probe,
                               ssim_rows,
                               ssim_gradient_rows,
                               normal_rows,
                               adam};
    return table;
}

}  // namespace surfkit
