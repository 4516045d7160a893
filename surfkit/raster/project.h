// From a splat to its record in one view, and from its color's gradient back; for every backend. In double: the
// including file gives square_root, natural_log and round_down for it.
#pragma once

#include "splat_math.h"
#include "records.h"

namespace surfkit {

using splat::Bound;
using splat::CameraModel;
using splat::Gaussian;
using splat::Posed;
using splat::SplatGrad;
using splat::SplatIn;
using splat::Vec;

SPLAT_FN int scale_columns(Kind kind) { return kind == kSurfel ? 2 : 3; }
SPLAT_FN double clamped(double x, double low, double high) { return splat::smallest(splat::largest(x, low), high); }

// Row i of activated values. `Arrays` has means, quats, scales (2 or 3 columns), opacities, sh and the number of its
// coefficients.
template <class Arrays>
SPLAT_FN SplatIn<double> read_splat(const Arrays& s, long long i, int columns) {
    SplatIn<double> o{};
    o.mean = {s.means[3 * i], s.means[3 * i + 1], s.means[3 * i + 2]};
    for (int k = 0; k < 4; k++) o.quat[k] = s.quats[4 * i + k];
    for (int k = 0; k < columns; k++) o.scale[k] = s.scales[columns * i + k];
    o.opacity = s.opacities[i];
    return o;
}

SPLAT_FN bool is_finite(double x) { return x - x == 0; }

SPLAT_FN bool valid(const SplatIn<double>& s, int columns) {
    double sum = s.mean.x + s.mean.y + s.mean.z + s.opacity, turn = 0;
    bool positive = true;
    for (double q : s.quat) turn += q * q;
    for (int k = 0; k < columns; k++) {
        sum += s.scale[k];
        positive = positive && s.scale[k] > 0;
    }
    return is_finite(sum) && is_finite(turn) && turn > 0 && positive;
}

// Colour of a splat seen from the camera, and what its gradient needs.
struct Shade {
    splat::Sight<double> sight;
    double rgb[3];
};
template <class Arrays>
SPLAT_FN Shade shade(const Arrays& s, long long i, const SplatIn<double>& in, const CameraModel<double>& cam) {
    Shade o{splat::sight(in.mean, cam.centre, s.coefficients), {0.5, 0.5, 0.5}};
    const long long row = 3LL * s.coefficients * i;
    for (int k = 0; k < s.coefficients; k++)
        for (int c = 0; c < 3; c++) o.rgb[c] += o.sight.basis[k] * s.sh[row + 3 * k + c];
    return o;
}
// `out_sh` has the layout of s.sh.
template <class Arrays, class Out>
SPLAT_FN void shade_backward(const Arrays& s, long long i, const Shade& o, const double rgb[3], SplatGrad<double>& out,
                             const Out& out_sh) {
    double g[3], weight[16] = {};
    for (int c = 0; c < 3; c++) g[c] = o.rgb[c] > 0 ? rgb[c] : 0;
    const long long row = 3LL * s.coefficients * i;
    for (int k = 0; k < s.coefficients; k++)
        for (int c = 0; c < 3; c++) {
            out_sh[row + 3 * k + c] = (float)(g[c] * o.sight.basis[k]);
            weight[k] += g[c] * s.sh[row + 3 * k + c];
        }
    if (s.coefficients > 1 && o.sight.length > 0)
        out.mean = out.mean + splat::sight_backward(o.sight, s.coefficients, weight);
}

// A little larger than exact, so that the float32 row test never loses a pixel.
SPLAT_FN Bound<double> widened(Bound<double> b) {
    const double more = 1.0001, pad = 1e-3;
    b.hxx = b.hxx * more + pad;
    b.hxy *= more;
    b.hyy = b.hyy * more + pad;
    if (b.r2 > 0) {
        b.r2 = b.r2 * more + pad;
        // A disc inside the ellipse says nothing new.
        const double half = (b.hxx + b.hyy) / 2,
                     spread = square_root((b.hxx - b.hyy) * (b.hxx - b.hyy) / 4 + b.hxy * b.hxy);
        if (half > spread &&
            square_root(half - spread) >
                square_root(b.r2) + square_root((b.dx - b.mx) * (b.dx - b.mx) + (b.dy - b.my) * (b.dy - b.my)))
            b.r2 = -1;
    }
    return b;
}

template <class Record>
SPLAT_FN void fill_bound(Record& r, const Bound<double>& b) {
    const double tilt = b.hxy / b.hyy, ax = r.ax, ay = r.ay;
    r.mx = (float)(b.mx - ax);
    r.my = (float)(b.my - ay);
    r.tilt = (float)tilt;
    r.wide = (float)splat::largest(b.hxx - b.hxy * tilt, 0.0);
    r.flat = (float)(1 / b.hyy);
    r.disc_x = (float)(b.dx - ax);
    r.disc_y = (float)(b.dy - ay);
    r.disc_r2 = (float)b.r2;
}
template <class Record>
SPLAT_FN void fill_look(Record& r, double opacity, const Shade& look, Vec<double> normal) {
    r.opacity = (float)opacity;
    for (int c = 0; c < 3; c++) r.color[c] = (float)splat::largest(look.rgb[c], 0.0);
    r.normal[0] = (float)normal.x;
    r.normal[1] = (float)normal.y;
    r.normal[2] = (float)normal.z;
}

SPLAT_FN void fill_record(SurfelRecord& r, double opacity, const splat::SurfelView<double>& s) {
    r.ax = (float)s.ax;
    r.ay = (float)s.ay;
    const Vec<double> m[3] = {s.a, s.b, s.c};
    double* to[3] = {r.a, r.b, r.c};
    for (int k = 0; k < 3; k++) {
        to[k][0] = m[k].x;
        to[k][1] = m[k].y;
        to[k][2] = m[k].z;
    }
    r.det = (float)s.det;
    r.z_low = (float)s.z_low;
    r.z_high = (float)s.z_high;
    fill_look(r, opacity, Shade{}, s.normal);
    for (int k = 0; k < 6; k++) r.signal_x[k] = (float)s.signal.x[k];
    for (int k = 0; k < 3; k++) r.signal_y[k] = (float)s.signal.y[k == 2 ? 4 : 2 * k + 1];
}
SPLAT_FN bool project_one(const SplatIn<double>& in, const CameraModel<double>& cam, const splat::GaussianForm&,
                          SurfelRecord& r, Bound<double>& bound) {
    splat::SurfelView<double> s;
    if (!splat::surfel_view(in, cam, s)) return false;
    bound = s.bound;
    fill_record(r, in.opacity, s);
    return true;
}
// What both records of gaussians have.
template <class Record>
SPLAT_FN void fill_footprint(Record& r, const Gaussian<double>& g) {
    const double limit = 1 << 22, ax = round_down(clamped(g.x, -limit, limit)) + 0.5,
                 ay = round_down(clamped(g.y, -limit, limit)) + 0.5;
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
SPLAT_FN bool project_one(const SplatIn<double>& in, const CameraModel<double>& cam, const splat::GaussianForm& form,
                          GaussianRecord& r, Bound<double>& bound) {
    const Posed<double> p = splat::pose(in, cam);
    Gaussian<double> g;
    if (!splat::gaussian_project(in, p, cam, form, g)) return false;
    bound = g.bound;
    fill_footprint(r, g);
    r.slope_x = (float)g.slope_x;
    r.slope_y = (float)g.slope_y;
    fill_look(r, in.opacity * g.compensation, Shade{}, g.normal);
    return true;
}
SPLAT_FN bool project_one(const SplatIn<double>& in, const CameraModel<double>& cam, const splat::GaussianForm& form,
                          RayRecord& r, Bound<double>& bound) {
    const Posed<double> p = splat::pose(in, cam);
    Gaussian<double> g;
    if (!splat::gaussian_project(in, p, cam, form, g)) return false;
    bound = g.bound;
    fill_footprint(r, g);
    r.bend_x = (float)(-g.slope_x / g.z);
    r.bend_y = (float)(-g.slope_y / g.z);
    r.kappa = (float)g.kappa;
    r.opacity = (float)in.opacity;
    const Vec<double> m[3] = {g.steep, g.steep_x, g.steep_y};
    float* to[3] = {r.steep, r.steep_x, r.steep_y};
    for (int k = 0; k < 3; k++) {
        to[k][0] = (float)m[k].x;
        to[k][1] = (float)m[k].y;
        to[k][2] = (float)m[k].z;
    }
    return true;
}

// What a camera sees, for leaving out early what lies well outside: in a large scene that is nearly everything.
struct Outlook {
    static constexpr double kMargin = 3;  // pixels; the low-pass filter of a surfel reaches 2.36
    const CameraModel<double>& cam;
    Vec<double> side[4];  // unit normals of the planes through the camera and the sides of the image, pointing away

    explicit Outlook(const CameraModel<double>& camera) : cam(camera) {
        const double left = -kMargin - cam.cx, right = cam.width + kMargin - cam.cx, top = -kMargin - cam.cy,
                     bottom = cam.height + kMargin - cam.cy;
        const Vec<double> away[4] = {{-cam.fx, 0, left}, {cam.fx, 0, -right}, {0, -cam.fy, top}, {0, cam.fy, -bottom}};
        for (int k = 0; k < 4; k++) side[k] = (1 / square_root(splat::dot(away[k], away[k]))) * away[k];
    }

    // Whether a splat with its centre at c in the camera frame surely touches no pixel.
    bool misses(Kind kind, const SplatIn<double>& in, Vec<double> c) const {
        if (!(c.z > cam.near)) return true;
        const double reach = splat::largest(in.scale[0], splat::largest(in.scale[1], in.scale[2])) *
                             square_root(splat::kCutoffSquared) * 1.0001;
        if (kind == kGaussian) return misses_blurred(reach, c);
        for (const Vec<double>& away : side)
            if (splat::dot(away, c) > reach) return true;
        return false;
    }

  private:
    // The footprint of a gaussian is affine in its covariance, at a slope that is held near the image.
    bool misses_blurred(double reach, Vec<double> c) const {
        const auto apart = [&](double slope, double f, double principal, int pixels) {
            const double more = 0.15 * pixels / f,
                         held = clamped(slope, -principal / f - more, (pixels - principal) / f + more);
            const double half = f / c.z * reach * square_root(1 + held * held) + 2 + kMargin,
                         at = f * slope + principal;
            return at + half < 0 || at - half > pixels;
        };
        return apart(c.x / c.z, cam.fx, cam.cx, cam.width) || apart(c.y / c.z, cam.fy, cam.cy, cam.height);
    }
};

// Calls f(tile) for the tiles that a bound touches. Tile t holds the pixel centres 16 t + rim ... 16 t + 16 - rim with
// a rim of 0.5; with none, what lies between them too.
template <class F>
SPLAT_FN void each_tile(const Bound<double>& b, int tiles_x, int tiles_y, double rim, F f) {
    const auto first = [&](double low, int tiles) {
        return (int)clamped(-round_down(-((low + rim) / kTile - 1)), 0.0, (double)tiles);
    };
    const auto end = [&](double high, int tiles) {
        return (int)clamped(round_down((high - rim) / kTile) + 1, 0.0, (double)tiles);
    };
    const double disc = b.r2 > 0 ? square_root(b.r2) : 0, dx = b.r2 > 0 ? b.dx : b.mx, dy = b.r2 > 0 ? b.dy : b.my;
    const double hx = square_root(b.hxx), hy = square_root(b.hyy);
    const double x0 = splat::smallest(b.mx - hx, dx - disc), x1 = splat::largest(b.mx + hx, dx + disc),
                 y0 = splat::smallest(b.my - hy, dy - disc), y1 = splat::largest(b.my + hy, dy + disc);
    const int left = first(x0, tiles_x), right = end(x1, tiles_x), top = first(y0, tiles_y), bottom = end(y1, tiles_y);
    if (left >= right) return;
    // Most splats are small. In a single row or column their box tells all, but for what lies between pixel centres.
    // Large ones may be single only because the image ends there; of these the box holds far too much.
    const bool single = bottom - top == 1 || right - left == 1;
    if (single && x1 - x0 < 2 * kTile && y1 - y0 < 2 * kTile) {
        for (int y = top; y < bottom; y++)
            for (int x = left; x < right; x++) f(y * tiles_x + x);
        return;
    }
    const splat::Outline<double> o = splat::outline(b);
    for (int y = top; y < bottom; y++) {
        double low, high;
        if (!splat::bound_span(b, o, y * kTile + rim, (y + 1) * kTile - rim, low, high)) continue;
        const int last = end(high, tiles_x);
        for (int x = first(low, tiles_x); x < last; x++) f(y * tiles_x + x);
    }
}

// What the pixels' sums mean, by kind, as cotangents of what splat_math.h projects.
SPLAT_FN splat::SurfelSums<double> surfel_sums(const double* s) {
    return {
        {s[0], s[1], s[2]}, {s[3], s[4], s[5]}, {s[6], s[7], s[8]}, s[9], {s[10], s[11]}, {s[12], s[13], s[14]}, s[15]};
}
SPLAT_FN splat::GaussianSums<double> gaussian_sums(const double* s) {
    return {s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], {s[8], s[9], s[10]}, s[11], s[5]};
}
SPLAT_FN splat::RaySums<double> ray_sums(const double* s) {
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
SPLAT_FN SplatGrad<double> splat_backward(Kind kind, const SplatIn<double>& in, const CameraModel<double>& cam,
                                          const splat::GaussianForm& form, const double* s) {
    SplatGrad<double> g;
    if (kind == kSurfel) {
        splat::surfel_gradient(in, cam, surfel_sums(s), g);
    } else {
        const Posed<double> p = splat::pose(in, cam);
        Gaussian<double> o;
        splat::gaussian_project(in, p, cam, form, o);
        const splat::RaySums<double> ray = ray_sums(s);
        const bool rays = kind == kGaussianRay;
        splat::gaussian_backward(in, p, cam, form, o, rays ? splat::plane_sums(o, ray) : gaussian_sums(s),
                                 rays ? &ray : nullptr, g);
    }
    return g;
}

}  // namespace surfkit
