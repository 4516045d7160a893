// From a splat to its record in one view, and from its color's gradient back; for every backend. In Real, which the
// including file gives with its square_root, natural_log and round_down: a double on the CPU, a Pair on a GPU.
#pragma once

#include "splat_math.h"
#include "records.h"

namespace surfkit {

using splat::Bound;
using splat::CameraModel;
using splat::Gaussian;
using splat::Outline;
using splat::Posed;
using splat::SplatGrad;
using splat::SplatIn;
using splat::Vec;
typedef splat::GaussianForm<Real> GaussianForm;

SPLAT_FN int scale_columns(Kind kind) { return kind == kSurfel ? 2 : 3; }
template <class R>
SPLAT_FN R clamped(R x, R low, R high) {
    return splat::smallest(splat::largest(x, low), high);
}

// Row i of activated values. `Arrays` has means, quats, scales (2 or 3 columns), opacities, sh0, sh_rest and the number
// of coefficients.
template <class Arrays>
SPLAT_FN SplatIn<Real> read_splat(const Arrays& s, long long i, int columns) {
    SplatIn<Real> o{};
    o.mean = {s.means[3 * i], s.means[3 * i + 1], s.means[3 * i + 2]};
    for (int k = 0; k < 4; k++) o.quat[k] = s.quats[4 * i + k];
    for (int k = 0; k < columns; k++) o.scale[k] = s.scales[columns * i + k];
    o.opacity = s.opacities[i];
    return o;
}

// Whether all is finite and what must be positive is.
SPLAT_FN bool valid(const SplatIn<Real>& s, int columns) {
    const Real turn = s.quat[0] * s.quat[0] + s.quat[1] * s.quat[1] + s.quat[2] * s.quat[2] + s.quat[3] * s.quat[3];
    const auto lost = [](Real x) { return (float)x - (float)x; };  // 0, or NaN where x is not finite
    float none = (float)(turn - turn) + lost(s.mean.x) + lost(s.mean.y) + lost(s.mean.z) + lost(s.opacity);
    bool positive = turn > 0;
    for (int k = 0; k < columns; k++) {
        none += lost(s.scale[k]);
        positive = positive && s.scale[k] > 0;
    }
    return none == 0 && positive;
}

// Coefficient k of channel c of splat i.
template <class Arrays>
SPLAT_FN float harmonic(const Arrays& s, long long i, int k, int c) {
    return k ? s.sh_rest[3 * ((s.coefficients - 1) * i + k - 1) + c] : s.sh0[3 * i + c];
}

// Colour of a splat, below 0 too. The first term is exact: a black point has a colour of 0 but for what its number was
// rounded by, and it depends on the sign of that whether it can learn.
template <class Arrays, class R>
SPLAT_FN void shade(const Arrays& s, long long i, const splat::Sight<R>& sight, R rgb[3]) {
    for (int c = 0; c < 3; c++) rgb[c] = R(Real(0.5) + harmonic(s, i, 0, c) * Real(0.28209479177387814));
    for (int k = 1; k < s.coefficients; k++)
        for (int c = 0; c < 3; c++) rgb[c] += sight.basis[k] * harmonic(s, i, k, c);
}

// How a colour follows its splat: whether each channel is above 0, and if so its gradient by the mean.
template <class R>
struct Tint {
    Vec<R> by_mean[3];
    bool is_lit[3];
};
template <class Arrays, class R>
SPLAT_FN Tint<R> tint(const Arrays& s, long long i, const splat::Sight<R>& sight, const R rgb[3]) {
    Tint<R> o{};
    for (int c = 0; c < 3; c++) {
        o.is_lit[c] = rgb[c] > 0;
        if (!o.is_lit[c] || s.coefficients == 1 || !(sight.length > 0)) continue;
        R by_basis[16];
        for (int k = 0; k < s.coefficients; k++) by_basis[k] = harmonic(s, i, k, c);
        o.by_mean[c] = splat::sight_backward(sight, s.coefficients, by_basis);
    }
    return o;
}

// A little larger than exact, so that the float32 row test never loses a pixel.
SPLAT_FN Bound<Real> widened(Bound<Real> b) {
    const Real more = 1.0001, pad = 1e-3;
    b.hxx = b.hxx * more + pad;
    b.hxy *= more;
    b.hyy = b.hyy * more + pad;
    if (b.r2 > 0) {
        b.r2 = b.r2 * more + pad;
        // A disc inside the ellipse says nothing new. The share of `half` is more than a float loses in the difference.
        const auto hxx = rough(b.hxx), hxy = rough(b.hxy), hyy = rough(b.hyy), dx = rough(b.dx - b.mx),
                   dy = rough(b.dy - b.my), half = (hxx + hyy) / 2, share = half / (1 << 20),
                   spread = square_root((hxx - hyy) * (hxx - hyy) / 4 + hxy * hxy) + share;
        if (half > spread && square_root(half - spread) > square_root(rough(b.r2)) + square_root(dx * dx + dy * dy))
            b.r2 = -1;
    }
    return b;
}

template <class Record>
SPLAT_FN void fill_bound(Record& r, const Bound<Real>& b) {
    const Real tilt = b.hxy / b.hyy, ax = r.ax, ay = r.ay;
    r.mx = (float)(b.mx - ax);
    r.my = (float)(b.my - ay);
    r.tilt = (float)tilt;
    r.wide = (float)splat::largest(b.hxx - b.hxy * tilt, Real(0));
    r.flat = (float)(1 / b.hyy);
    r.disc_x = (float)(b.dx - ax);
    r.disc_y = (float)(b.dy - ay);
    r.disc_r2 = (float)b.r2;
}
template <class Record>
SPLAT_FN void fill_look(Record& r, Real opacity, Vec<Real> normal) {
    r.opacity = (float)opacity;
    r.normal[0] = (float)normal.x;
    r.normal[1] = (float)normal.y;
    r.normal[2] = (float)normal.z;
}

SPLAT_FN void fill_record(SurfelRecord& r, Real opacity, const splat::SurfelView<Real>& s) {
    r.ax = (float)s.ax;
    r.ay = (float)s.ay;
    const Vec<Real> m[3] = {s.a, s.b, s.c};
    Real* to[3] = {r.a, r.b, r.c};
    for (int k = 0; k < 3; k++) {
        to[k][0] = m[k].x;
        to[k][1] = m[k].y;
        to[k][2] = m[k].z;
    }
    r.det = (float)s.det;
    r.z_low = (float)s.z_low;
    r.z_high = (float)s.z_high;
    fill_look(r, opacity, s.normal);
    for (int k = 0; k < 6; k++) r.signal_x[k] = (float)s.signal.x[k];
    for (int k = 0; k < 3; k++) r.signal_y[k] = (float)s.signal.y[k == 2 ? 4 : 2 * k + 1];
}
SPLAT_FN bool project_one(const SplatIn<Real>& in, const CameraModel<Real>& cam, const GaussianForm&,
                          SurfelRecord& r, Bound<Real>& bound) {
    splat::SurfelView<Real> s;
    if (!splat::surfel_view(in, cam, s)) return false;
    bound = s.bound;
    fill_record(r, in.opacity, s);
    return true;
}
// What both records of gaussians have.
template <class Record>
SPLAT_FN void fill_footprint(Record& r, const Gaussian<Real>& g) {
    const auto limit = rough(Real(1 << 22)), near_x = rough(g.x), near_y = rough(g.y);
    const Real ax = round_down(clamped(near_x, -limit, limit)) + Real(0.5),
               ay = round_down(clamped(near_y, -limit, limit)) + Real(0.5);
    r.x = (float)(g.x - ax);
    r.y = (float)(g.y - ay);
    r.l00 = (float)g.l00;
    r.l01 = (float)g.l01;
    r.l11 = (float)g.l11;
    r.z = (float)g.z;
    r.z_low = (float)g.z_low;
    r.z_high = (float)g.z_high;
    r.ax = (float)ax;
    r.ay = (float)ay;
}
SPLAT_FN bool project_one(const SplatIn<Real>& in, const CameraModel<Real>& cam, const GaussianForm& form,
                          GaussianRecord& r, Bound<Real>& bound) {
    const Posed<Real> p = splat::pose(in, cam);
    Gaussian<Real> g;
    if (!splat::gaussian_project(in, p, cam, form, g)) return false;
    bound = g.bound;
    fill_footprint(r, g);
    r.slope_x = (float)g.slope_x;
    r.slope_y = (float)g.slope_y;
    fill_look(r, in.opacity * g.compensation, g.normal);
    return true;
}
SPLAT_FN bool project_one(const SplatIn<Real>& in, const CameraModel<Real>& cam, const GaussianForm& form,
                          RayRecord& r, Bound<Real>& bound) {
    const Posed<Real> p = splat::pose(in, cam);
    Gaussian<Real> g;
    if (!splat::gaussian_project(in, p, cam, form, g)) return false;
    bound = g.bound;
    fill_footprint(r, g);
    r.bend_x = (float)(-g.slope_x / g.z);
    r.bend_y = (float)(-g.slope_y / g.z);
    r.kappa = (float)g.kappa;
    r.opacity = (float)in.opacity;
    const Vec<Real> m[3] = {g.steep, g.steep_x, g.steep_y};
    float* to[3] = {r.steep, r.steep_x, r.steep_y};
    for (int k = 0; k < 3; k++) {
        to[k][0] = (float)m[k].x;
        to[k][1] = (float)m[k].y;
        to[k][2] = (float)m[k].z;
    }
    return true;
}

template <class R>
SPLAT_FN R largest_scale(const SplatIn<R>& s) {
    return splat::largest(s.scale[0], splat::largest(s.scale[1], s.scale[2]));
}

// What a camera sees, for leaving out early what lies well outside: in a large scene that is nearly everything. A float
// is exact enough: kMargin is more than what it loses.
template <class R>
struct Outlook {
    static constexpr float kMargin = 3;  // pixels; the low-pass filter of a surfel reaches 2.36
    CameraModel<R> cam;
    Vec<R> side[4];  // unit normals of the planes through the camera and the sides of the image, pointing away

    Outlook() = default;
    explicit Outlook(const CameraModel<R>& camera) : cam(camera) {
        const R margin = kMargin, none = 0, left = -margin - cam.cx, right = cam.width + margin - cam.cx,
                top = -margin - cam.cy, bottom = cam.height + margin - cam.cy;
        const Vec<R> away[4] = {
            {-cam.fx, none, left}, {cam.fx, none, -right}, {none, -cam.fy, top}, {none, cam.fy, -bottom}};
        for (int k = 0; k < 4; k++) side[k] = (1 / square_root(splat::dot(away[k], away[k]))) * away[k];
    }

    // Whether a splat of so large a scale with its centre at c in the camera frame surely touches no pixel.
    bool misses(Kind kind, R scale, Vec<R> c) const {
        if (c.z < cam.near) return true;
        const R reach = scale * square_root(R(splat::kCutoffSquared)) * R(1.0001);
        if (kind == kGaussian) return misses_blurred(reach, c);
        for (const Vec<R>& away : side)
            if (splat::dot(away, c) > reach) return true;
        return false;
    }

  private:
    // The footprint of a gaussian is affine in its covariance, at a slope that is held near the image.
    bool misses_blurred(R reach, Vec<R> c) const {
        const auto apart = [&](R slope, R f, R principal, int pixels) {
            const R more = R(0.15) * pixels / f,
                    held = clamped(slope, -principal / f - more, (pixels - principal) / f + more);
            const R half = f / c.z * reach * square_root(1 + held * held) + 2 + kMargin, at = f * slope + principal;
            return at + half < 0 || at - half > pixels;
        };
        return apart(c.x / c.z, cam.fx, cam.cx, cam.width) || apart(c.y / c.z, cam.fy, cam.cy, cam.height);
    }
};

// Calls f(tile) for the tiles that a bound touches, which is about the point (ax, ay). Tile t holds the pixel centres
// 16 t + rim ... 16 t + 16 - rim with a rim of 0.5; with none, what lies between them too.
template <class R, class F>
SPLAT_FN void each_tile(const Bound<R>& b, const Outline<R>& o, R ax, R ay, int tiles_x, int tiles_y, R rim, F f) {
    // The point's tile apart, which is exact: only the rest is rounded.
    const auto first = [&](R low, R from, int tiles) {
        const R tile = round_down(from / kTile), rest = low + (from - tile * kTile);
        return (int)clamped(tile - round_down(-((rest + rim) / kTile - 1)), R(0), R(tiles));
    };
    const auto end = [&](R high, R from, int tiles) {
        const R tile = round_down(from / kTile), rest = high + (from - tile * kTile);
        return (int)clamped(tile + round_down((rest - rim) / kTile) + 1, R(0), R(tiles));
    };
    const R disc = b.r2 > 0 ? square_root(b.r2) : R(0), dx = b.r2 > 0 ? b.dx : b.mx, dy = b.r2 > 0 ? b.dy : b.my;
    const R x0 = splat::smallest(b.mx - o.hx, dx - disc), x1 = splat::largest(b.mx + o.hx, dx + disc),
            y0 = splat::smallest(b.my - o.hy, dy - disc), y1 = splat::largest(b.my + o.hy, dy + disc);
    const int left = first(x0, ax, tiles_x), right = end(x1, ax, tiles_x), top = first(y0, ay, tiles_y),
              bottom = end(y1, ay, tiles_y);
    if (left >= right) return;
    // Most splats are small. In a single row or column their box tells all, but for what lies between pixel centres.
    // Large ones may be single only because the image ends there; of these the box holds far too much.
    const bool single = bottom - top == 1 || right - left == 1;
    if (single && x1 - x0 < 2 * kTile && y1 - y0 < 2 * kTile) {
        for (int y = top; y < bottom; y++)
            for (int x = left; x < right; x++) f(y * tiles_x + x);
        return;
    }
    for (int y = top; y < bottom; y++) {
        R low, high;
        if (!splat::bound_span(b, o, y * kTile - ay + rim, (y + 1) * kTile - ay - rim, low, high)) continue;
        const int last = end(high, ax, tiles_x);
        for (int x = first(low, ax, tiles_x); x < last; x++) f(y * tiles_x + x);
    }
}

// What the pixels' sums mean, by kind, as cotangents of what splat_math.h projects.
SPLAT_FN splat::SurfelSums<Real> surfel_sums(const Real* s) {
    return {
        {s[0], s[1], s[2]}, {s[3], s[4], s[5]}, {s[6], s[7], s[8]}, s[9], {s[10], s[11]}, {s[12], s[13], s[14]}, s[15]};
}
SPLAT_FN splat::GaussianSums<Real> gaussian_sums(const Real* s) {
    return {s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], {s[8], s[9], s[10]}, s[11], s[5]};
}
SPLAT_FN splat::RaySums<Real> ray_sums(const Real* s) {
    return {s[0],
            s[1],
            s[2],
            s[3],
            s[4],
            s[5],
            s[6],
            s[7],
            s[8],
            s[9],
            {s[10], s[11], s[12]},
            {s[13], s[14], s[15]},
            {s[16], s[17], s[18]},
            s[19]};
}

// dL/d(splat) but for its color, from the sums over its pixels.
SPLAT_FN SplatGrad<Real> splat_backward(Kind kind, const SplatIn<Real>& in, const CameraModel<Real>& cam,
                                          const GaussianForm& form, const Real* s) {
    SplatGrad<Real> g;
    if (kind == kSurfel) {
        splat::surfel_gradient(in, cam, surfel_sums(s), g);
    } else {
        const Posed<Real> p = splat::pose(in, cam);
        Gaussian<Real> o;
        splat::gaussian_project(in, p, cam, form, o);
        const splat::RaySums<Real> ray = ray_sums(s);
        const bool rays = kind == kGaussianRay;
        splat::gaussian_backward(in, p, cam, form, o, rays ? splat::plane_sums(o, ray) : gaussian_sums(s),
                                 rays ? &ray : nullptr, g);
    }
    return g;
}

}  // namespace surfkit
