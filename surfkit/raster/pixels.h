// The formulas per pixel, once for every backend: a splat at pixels of a tile, how it is blended, and the way back.
//
// The including file gives Floats, Ints and Mask, which are numbers of one pixel or vectors of several, and their
// functions (native/simd.h; cuda/scalar.h).
#pragma once

#include "splat_math.h"
#include "records.h"

namespace surfkit {
namespace {

using splat::kAlphaMax;
using splat::kAlphaMin;
using splat::kTransmittanceMin;

// ---- a splat seen from one tile: offsets are from the tile's centre, where they are smallest and so most exact in a
// product. (sx, sy): the tile's centre less the splat's anchor.

struct Size {
    int width, height;
};

struct LocalSurfel {
    float a[3], b[3], c[3], det, low_x, low_y, z_low, z_high, opacity;
    static SURFKIT_INLINE LocalSurfel of(const SurfelRecord& s, float sx, float sy) {
        LocalSurfel o;
        for (int i = 0; i < 3; i++) {
            o.a[i] = (float)s.a[i];
            o.b[i] = (float)s.b[i];
            o.c[i] = (float)(s.c[i] + sx * s.a[i] + sy * s.b[i]);
        }
        o.det = s.det;
        o.low_x = s.disc_x - sx;
        o.low_y = s.disc_y - sy;
        o.z_low = s.z_low;
        o.z_high = s.z_high;
        o.opacity = s.opacity;
        return o;
    }
};
struct LocalGaussian {
    float x, y, l00, l01, l11, z, slope_x, slope_y, z_low, z_high, opacity;
    static SURFKIT_INLINE LocalGaussian of(const GaussianRecord& s, float sx, float sy) {
        return {s.x - sx, s.y - sy, s.l00, s.l01, s.l11, s.z, s.slope_x, s.slope_y, s.z_low, s.z_high, s.opacity};
    }
};
struct LocalRay {
    float sx, sy, x, y, l00, l01, l11, z, z_low, z_high, bend_x, bend_y, kappa, opacity;
    static SURFKIT_INLINE LocalRay of(const RayRecord& s, float sx, float sy) {
        return {sx, sy, s.x, s.y, s.l00, s.l01, s.l11, s.z, s.z_low, s.z_high, s.bend_x, s.bend_y, s.kappa, s.opacity};
    }
};

struct SurfelPixel {
    splat::SurfelHit<Floats> hit;
    Mask on_disc, free_z;
    Floats half_rho, z;
    SURFKIT_INLINE void shape(const LocalSurfel& s, Floats x, Floats y) {
        hit = splat::surfel_hit<Floats>(s, x, y, on_disc);
        half_rho = 0.5f * hit.rho;
    }
    SURFKIT_INLINE void depth(const LocalSurfel& s) { z = splat::surfel_depth<Floats>(s, hit, free_z); }
    template <class Look>
    SURFKIT_INLINE void face(const Look&) {}
    template <class Look>
    SURFKIT_INLINE float normal(const Look& s, int c) const {
        return s.normal[c];
    }
};
struct GaussianPixel {
    Floats dx, dy;
    Mask free_z;
    Floats half_rho, z;
    SURFKIT_INLINE void shape(const LocalGaussian& s, Floats x, Floats y) {
        dx = x - s.x;
        dy = y - s.y;
        const Floats p = madd(dx, s.l00, dy * s.l01), q = dy * s.l11;
        half_rho = 0.5f * madd(p, p, q * q);
    }
    SURFKIT_INLINE void depth(const LocalGaussian& s) {
        const Floats plane = madd(dx, s.slope_x, madd(dy, s.slope_y, broadcast(s.z)));
        free_z = less_equal(s.z_low, plane) & less_equal(plane, s.z_high);
        z = select(free_z, plane, select(less_equal(s.z_high, plane), s.z_high, s.z_low));
    }
    template <class Look>
    SURFKIT_INLINE void face(const Look&) {}
    template <class Look>
    SURFKIT_INLINE float normal(const Look& s, int c) const {
        return s.normal[c];
    }
};
struct RayPixel {
    Floats dx, dy, p, q, r, u, inv, facing[3], inverse_length;
    Mask free_z;
    Floats half_rho, z;
    SURFKIT_INLINE void shape(const LocalRay& s, Floats x, Floats y) {
        // The first sum is exact: offsets near the centre are too, which thin ellipsoids without dilation need.
        dx = (x + s.sx) - s.x;
        dy = (y + s.sy) - s.y;
        p = madd(dx, s.l00, dy * s.l01);
        q = dy * s.l11;
        r = madd(p, p, q * q);
        u = madd(dx, s.bend_x, madd(dy, s.bend_y, broadcast(1.0f)));
        inv = reciprocal(madd(u, u, s.kappa * r));
        half_rho = 0.5f * r * inv;
    }
    SURFKIT_INLINE void depth(const LocalRay& s) {
        const Floats at = s.z * u * inv;
        free_z = less_equal(s.z_low, at) & less_equal(at, s.z_high);
        z = select(free_z, at, select(less_equal(s.z_high, at), s.z_high, s.z_low));
    }
    template <class Look>
    SURFKIT_INLINE void face(const Look& s) {
        for (int c = 0; c < 3; c++) facing[c] = madd(dx, s.steep_x[c], madd(dy, s.steep_y[c], broadcast(s.steep[c])));
        const Floats square = madd(facing[0], facing[0], madd(facing[1], facing[1], facing[2] * facing[2]));
        inverse_length = reciprocal(root(higher(square, broadcast(1e-30f))));
        for (int c = 0; c < 3; c++) facing[c] = -(facing[c] * inverse_length);
    }
    template <class Look>
    SURFKIT_INLINE Floats normal(const Look&, int c) const {
        return facing[c];
    }
};

// A splat::SignalRow about the tile's centre; gaussians use the first three factors of each direction.
struct LocalSignal {
    float x[6], y[6];
    static SURFKIT_INLINE LocalSignal of(Size image, const SurfelRecord& s, float sx, float sy) {
        const float side = (float)image.height / (float)image.width, *const f = s.signal_x, *const g = s.signal_y;
        return {{f[0], f[1] + sy * f[0], f[2], f[3] + sy * f[2], f[4], f[5]},
                {-side * f[0], g[0] - sx * side * f[0], -side * f[2], g[1] - sx * side * f[2], g[2], side * f[5]}};
    }
    static SURFKIT_INLINE LocalSignal of(Size image, const GaussianRecord& s, float, float) {
        return of_footprint(image, s, s.slope_x, s.slope_y);
    }
    static SURFKIT_INLINE LocalSignal of(Size image, const RayRecord& s, float, float) {
        return of_footprint(image, s, s.bend_x, s.bend_y);
    }

  private:
    template <class Record>
    static SURFKIT_INLINE LocalSignal of_footprint(Size image, const Record& s, float slope_x, float slope_y) {
        const float half_w = 0.5f * (float)image.width, half_h = 0.5f * (float)image.height, cross = s.l00 * s.l01;
        return {{half_w * s.l00 * s.l00, half_w * cross, -half_w * slope_x},
                {half_h * cross, half_h * (s.l01 * s.l01 + s.l11 * s.l11), -half_h * slope_y}};
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

struct Rays {
    using Record = RayRecord;
    using Local = LocalRay;
    using Pixel = RayPixel;
    static constexpr int sums = kRaySums, sums_chosen = kRaySumsChosen;
};

// ---- forward

// What is kept of the rays of some pixels while splats are blended front to back.
template <int level>
struct Ray {
    Floats open = broadcast(1.0f), color[3] = {}, depth{}, median{}, normal[3] = {};
    Floats bend{}, shift{}, m1{}, m2{};  // distortion, and what it needs: inverse depth of the first splat, two moments
    Ints last = Ints{} - 1, middle = Ints{} - 1;
    Mask alive;

    // Blends one splat, the tile's `here`-th. False if it is blended into none of the pixels.
    template <class K, class Look>
    SURFKIT_INLINE bool blend(const typename K::Local& local, const Look& s, Floats x, Floats y, Ints here) {
        typename K::Pixel at;
        at.shape(local, x, y);
        const Floats alpha = lower(local.opacity * exp_negative(-at.half_rho), broadcast(kAlphaMax));
        Mask m = less_equal(kAlphaMin, alpha) & alive;
        if (!any(m)) return false;
        const Floats before = open, after = before * (1.0f - alpha);
        const Mask ends = m & lesser(after, kTransmittanceMin);
        alive = without(alive, ends);
        m = without(m, ends);
        const Floats w = keep(m, alpha * before);
        for (int c = 0; c < 3; c++) color[c] = madd(w, s.color[c], color[c]);
        if (level >= kGeometry) {
            at.depth(local);
            depth = madd(w, at.z, depth);
            at.face(s);
            for (int c = 0; c < 3; c++) normal[c] = madd(w, at.normal(s, c), normal[c]);
            const Mask half = m & lesser(0.5f, before);
            median = select(half, at.z, median);
            middle = select(half, here, middle);
        }
        if (level >= kDistortion) {
            const Floats m_z = reciprocal(at.z);
            shift = select(m & equal(last, Ints{} - 1), m_z, shift);
            const Floats d = m_z - shift, wd = w * d;
            bend = bend + w * madd(d * d, 1.0f - before, m2 - 2.0f * d * m1);
            m1 = m1 + wd;
            m2 = madd(wd, d, m2);
        }
        open = select(m, after, before);
        last = select(m, here, last);
        return any(m);
    }

    // The median exists where half of the light is stopped.
    SURFKIT_INLINE void finish() {
        const Mask opaque = less_equal(open, 0.5f);
        median = keep(opaque, median);
        middle = select(opaque, middle, Ints{} - 1);
    }
};

// ---- backward

// The cotangents of one group of losses at some pixels, and the running sum of what lies behind.
template <int level>
struct Cotangents {
    Floats color[3] = {}, depth{}, median{}, normal[3] = {}, bend{}, behind{};

    // dL/d(weight) of a splat with inverse depth d about the shift.
    template <class Pixel, class Look>
    SURFKIT_INLINE Floats per_weight(const Pixel& at, const Look& s, Floats z, Floats d, Floats all, Floats m1,
                                     Floats m2) const {
        Floats dot = madd(color[0], s.color[0], madd(color[1], s.color[1], color[2] * s.color[2]));
        if (level >= kGeometry) {
            dot = madd(normal[0], at.normal(s, 0),
                       madd(normal[1], at.normal(s, 1), madd(normal[2], at.normal(s, 2), dot)));
            dot = madd(depth, z, dot);
        }
        if (level >= kDistortion) dot = madd(bend, madd(d * d, all, m2 - 2.0f * d * m1), dot);
        return dot;
    }
    // dL/dz of a splat with weight w, where it is the median's (`mid`) or not.
    SURFKIT_INLINE Floats per_depth(Floats w, Mask mid, Floats m_z, Floats d, Floats all, Floats m1) const {
        Floats g = madd(w, depth, keep(mid, median));
        if (level >= kDistortion) g = g - 2.0f * bend * w * madd(d, all, -m1) * (m_z * m_z);
        return g;
    }
};

// Sums over the pixels of a tile for one splat; the order is that of the structs in splat_math.h.
template <int level, int chosen>
struct SurfelAdder {
    static constexpr int width = chosen ? kSurfelSumsChosen : kSurfelSums;
    Floats s[width] = {};
    SURFKIT_INLINE void add(const SurfelPixel& at, const LocalSurfel&, Floats x, Floats y, Mask m, Floats e,
                            Floats dz) {
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
    SURFKIT_INLINE void add_chosen(const SurfelPixel& at, const LocalSurfel&, const LocalSignal& f, Floats x, Floats y,
                                   Mask m, Floats e, Floats dz) {
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
    SURFKIT_INLINE void add_normal(const SurfelPixel&, const Floats v[3]) {
        for (int c = 0; c < 3; c++) s[12 + c] += v[c];
    }
    SURFKIT_INLINE void add_opacity(Floats v) { s[15] += v; }
    SURFKIT_INLINE void add_color(int c, Floats v) { s[16 + c] += v; }
    // From sums about the tile's centre to sums about the anchor.
    static SURFKIT_INLINE void recentre(float* out, float sx, float sy) {
        for (int i = 0; i < 3; i++) {
            out[i] += sx * out[6 + i];
            out[3 + i] += sy * out[6 + i];
        }
    }
};
template <int level, int chosen>
struct GaussianAdder {
    static constexpr int width = chosen ? kGaussianSumsChosen : kGaussianSums;
    Floats s[width] = {};
    // `e` is dL/d(rho / 2); the moments are of dL/d(power) = -e.
    SURFKIT_INLINE void add(const GaussianPixel& at, const LocalGaussian&, Floats, Floats, Mask m, Floats e,
                            Floats dz) {
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
    SURFKIT_INLINE void add_chosen(const GaussianPixel& at, const LocalGaussian&, const LocalSignal& f, Floats, Floats,
                                   Mask m, Floats e, Floats dz) {
        Floats gx = -e * madd(at.dx, f.x[0], at.dy * f.x[1]), gy = -e * madd(at.dx, f.y[0], at.dy * f.y[1]);
        if (chosen != kChosenColor && level >= kGeometry) {
            const Floats t = keep(at.free_z & m, dz);
            gx = madd(t, f.x[2], gx);
            gy = madd(t, f.y[2], gy);
        }
        s[16] += chosen == kChosenAbsolute ? magnitude(gx) : gx;
        s[17] += chosen == kChosenAbsolute ? magnitude(gy) : gy;
    }
    SURFKIT_INLINE void add_normal(const GaussianPixel&, const Floats v[3]) {
        for (int c = 0; c < 3; c++) s[8 + c] += v[c];
    }
    SURFKIT_INLINE void add_opacity(Floats v) { s[11] += v; }
    SURFKIT_INLINE void add_color(int c, Floats v) { s[12 + c] += v; }
    static SURFKIT_INLINE void recentre(float*, float, float) {}
};
// With D = u^2 + kappa r: rho / 2 = r / 2D, depth = z u / D.
template <int level, int chosen>
struct RayAdder {
    static constexpr int width = chosen ? kRaySumsChosen : kRaySums;
    Floats s[width] = {};
    // dL/d(r) times 2, and dL/du; `e` is dL/d(rho / 2).
    struct Shares {
        Floats r, u;
    };
    static SURFKIT_INLINE Shares shares(const RayPixel& at, const LocalRay& local, Floats e, Floats t) {
        const Floats square = at.inv * at.inv;
        Floats r = e * (at.u * at.u) * square, u = -((e * at.r) * (at.u * square));
        if (level >= kGeometry) {
            const Floats tz = t * local.z;
            r = r - 2.0f * (tz * local.kappa) * (at.u * square);
            u = madd(tz, at.inv - 2.0f * (at.u * at.u) * square, u);
        }
        return {r, u};
    }
    static SURFKIT_INLINE Shares bent_shares(const RayPixel& at, const LocalRay& local, Floats e, Floats t, Floats c) {
        Shares g = shares(at, local, e, t);
        const Floats by_d = 2.0f * c * at.inv;
        g.r = madd(by_d, broadcast(local.kappa), g.r);
        g.u = madd(by_d, at.u, g.u);
        return g;
    }
    // Moments in sigmas: those in pixels cancel in the long direction of a needle, which no dilation makes wider.
    SURFKIT_INLINE void add_moments(const RayPixel& at, const Shares& g) {
        const Floats gp = -(g.r * at.p), gq = -(g.r * at.q);
        s[0] += gp;
        s[1] += gq;
        s[2] = madd(gp, at.p, s[2]);
        s[3] = madd(gp, at.q, s[3]);
        s[4] = madd(gq, at.q, s[4]);
        s[6] += g.u;
        s[7] = madd(g.u, at.dx, s[7]);
        s[8] = madd(g.u, at.dy, s[8]);
    }
    SURFKIT_INLINE void add_signal(const RayPixel& at, const Shares& g, const LocalSignal& f) {
        const Floats gx = madd(g.u, f.x[2], -(g.r * madd(at.dx, f.x[0], at.dy * f.x[1])));
        const Floats gy = madd(g.u, f.y[2], -(g.r * madd(at.dx, f.y[0], at.dy * f.y[1])));
        s[24] += chosen == kChosenAbsolute ? magnitude(gx) : gx;
        s[25] += chosen == kChosenAbsolute ? magnitude(gy) : gy;
    }
    SURFKIT_INLINE void add(const RayPixel& at, const LocalRay& local, Floats, Floats, Mask m, Floats e, Floats dz) {
        Floats t{};
        if (level >= kGeometry) t = keep(at.free_z & m, dz);
        const Floats kept = keep(m, e);
        add_moments(at, shares(at, local, kept, t));
        Floats k = -0.5f * kept * (at.r * at.inv) * (at.r * at.inv);
        if (level >= kGeometry) {
            const Floats tu = t * at.u * at.inv;
            s[5] += tu;
            k = k - tu * local.z * (at.r * at.inv);
        }
        s[9] += k;
    }
    SURFKIT_INLINE void add_chosen(const RayPixel& at, const LocalRay& local, const LocalSignal& f, Floats, Floats,
                                   Mask m, Floats e, Floats dz) {
        Floats t{};
        if (chosen != kChosenColor && level >= kGeometry) t = keep(at.free_z & m, dz);
        add_signal(at, shares(at, local, keep(m, e), t), f);
    }
    // The same with `c`, the gradient by the curve D / (kappa z^2) times that curve: see solids.h.
    SURFKIT_INLINE void add_bent(const RayPixel& at, const LocalRay& local, Floats e, Floats dz, Floats c) {
        add_moments(at, bent_shares(at, local, e, dz, c));
        const Floats ratio = at.r * at.inv, tu = dz * at.u * at.inv;
        s[5] += tu - c * (2.0f / local.z);
        s[9] += c * ratio - c * (1.0f / local.kappa) - ratio * (0.5f * e * ratio + tu * local.z);
    }
    SURFKIT_INLINE void add_chosen_bent(const RayPixel& at, const LocalRay& local, const LocalSignal& f, Floats e,
                                        Floats dz, Floats c) {
        add_signal(at, bent_shares(at, local, e, dz, c), f);
    }
    // By the vector that the normal is the direction of, and times the offset.
    SURFKIT_INLINE void add_normal(const RayPixel& at, const Floats v[3]) {
        const Floats along = madd(v[0], at.facing[0], madd(v[1], at.facing[1], v[2] * at.facing[2]));
        for (int c = 0; c < 3; c++) {
            const Floats t = (along * at.facing[c] - v[c]) * at.inverse_length;
            s[10 + c] += t;
            s[13 + c] = madd(t, at.dx, s[13 + c]);
            s[16 + c] = madd(t, at.dy, s[16 + c]);
        }
    }
    SURFKIT_INLINE void add_opacity(Floats v) { s[19] += v; }
    SURFKIT_INLINE void add_color(int c, Floats v) { s[20 + c] += v; }
    static SURFKIT_INLINE void recentre(float*, float, float) {}
};
template <class K, int level, int chosen>
struct AdderOf {
    using Type = SurfelAdder<level, chosen>;
};
template <int level, int chosen>
struct AdderOf<Gaussians, level, chosen> {
    using Type = GaussianAdder<level, chosen>;
};
template <int level, int chosen>
struct AdderOf<Rays, level, chosen> {
    using Type = RayAdder<level, chosen>;
};

// The way back along the rays of some pixels.
template <int level, int chosen>
struct Retrace {
    static constexpr int chosen_level = chosen == kChosenAll || chosen == kChosenAbsolute ? level : kColor;
    Floats open, all{}, shift{}, m1{}, m2{};
    Ints last = Ints{} - 1, middle = Ints{} - 1;
    Cotangents<level> total;
    Cotangents<chosen_level> part;

    // Takes back one splat, the tile's `here`-th, and adds its gradients to the adder; with `fixed` it only hides
    // others.
    template <class K, class Look, class Adder>
    SURFKIT_INLINE void step(const typename K::Local& local, const Look& s, const LocalSignal& signal, Floats x,
                             Floats y, Ints here, bool fixed, Adder& adder) {
        typename K::Pixel at;
        at.shape(local, x, y);
        const Floats fall = exp_negative(-at.half_rho), raw = local.opacity * fall;
        const Floats alpha = lower(raw, broadcast(kAlphaMax));
        const Mask m = less_equal(kAlphaMin, alpha) & less_equal(here, last);
        const Floats ra = reciprocal(1.0f - alpha), before = open * ra, w = keep(m, alpha * before);
        open = select(m, before, open);
        Floats m_z{}, d{}, z{};
        if (level >= kGeometry) {
            at.depth(local);
            at.face(s);
            z = at.z;
        }
        if (level >= kDistortion) {
            m_z = reciprocal(z);
            d = m_z - shift;
        }
        const Floats per_weight = total.per_weight(at, s, z, d, all, m1, m2);
        if (fixed) {
            total.behind = madd(w, per_weight, total.behind);
            if (chosen) part.behind = madd(w, part.per_weight(at, s, z, d, all, m1, m2), part.behind);
            return;
        }
        const Mask smooth = m & lesser(raw, kAlphaMax);
        const Floats da = keep(smooth, before * per_weight - total.behind * ra);
        total.behind = madd(w, per_weight, total.behind);
        adder.add_opacity(da * fall);
        for (int c = 0; c < 3; c++) adder.add_color(c, w * total.color[c]);
        Floats dz{};
        Mask mid = m;
        if (level >= kGeometry) {
            mid = m & equal(here, middle);
            dz = total.per_depth(w, mid, m_z, d, all, m1);
            const Floats facing[3] = {w * total.normal[0], w * total.normal[1], w * total.normal[2]};
            adder.add_normal(at, facing);
        }
        adder.add(at, local, x, y, m, -(da * raw), dz);
        if (chosen) {
            const Floats pw = part.per_weight(at, s, z, d, all, m1, m2);
            const Floats pa = keep(smooth, before * pw - part.behind * ra);
            part.behind = madd(w, pw, part.behind);
            Floats pz{};
            if (chosen_level >= kGeometry) pz = part.per_depth(w, mid, m_z, d, all, m1);
            adder.add_chosen(at, local, signal, x, y, m, -(pa * raw), pz);
        }
    }
};

}  // namespace
}  // namespace surfkit
