// The formulas of splatting, once, for every backend. Plain C++17, no includes: the CPU backend instantiates them with
// double or vectors of them (per splat) and SIMD vectors (per pixel), the CUDA backend with pairs of floats and floats.
//
// Per pixel, V is a float or a vector of floats and the including file provides, for V and its mask type:
//   madd(a, b, c) = a b + c rounded once where the machine can, reciprocal(a), lesser(a, b), less_equal(a, b),
//   select(mask, a, b), operator& on masks.
// Per splat, R is a double or, for surfels on the CPU, several, or a Pair on a GPU, and the including file provides
// `square_root`, `natural_log` and `round_down` for it, and `rough`: the same as a number that is cheaper, where there is
// one, for what need not be exact.
#pragma once

#ifndef SPLAT_FN
#define SPLAT_FN static inline
#endif

namespace splat {

constexpr double kPi = 3.14159265358979323846;
constexpr float kAlphaMax = 0.99f;
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr double kCutoffSquared = 11.082527090316832;  // 2 ln 255: opacity 1 falls to kAlphaMin at this many sigmas^2
constexpr double kEdgeOn = 2e-3;                       // radians between a disc's plane and its centre's ray
constexpr double kAntialiasFloor = 2.5e-5;
constexpr double kMinFootprint = 1e-6;  // px, of gaussians along rays, which nothing widens

// How gaussians are evaluated; see `Splats.geometry` in raster/api.py.
enum Geometry { kAxis = 0, kPlane = 1, kRay = 2, kSolid = 3 };  // from kRay on along rays

// ---- small vectors

template <class R>
struct Vec {
    R x, y, z;
};
template <class R>
SPLAT_FN Vec<R> operator+(Vec<R> a, Vec<R> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class R>
SPLAT_FN Vec<R> operator-(Vec<R> a, Vec<R> b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class R>
SPLAT_FN Vec<R> operator*(R s, Vec<R> a) {
    return {s * a.x, s * a.y, s * a.z};
}
template <class R>
SPLAT_FN Vec<R> times(Vec<R> a, Vec<R> b) {
    return {a.x * b.x, a.y * b.y, a.z * b.z};
}
template <class R>
SPLAT_FN R dot(Vec<R> a, Vec<R> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class R>
SPLAT_FN Vec<R> cross(Vec<R> a, Vec<R> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class R>
SPLAT_FN R largest(R a, R b) {
    return a > b ? a : b;
}
template <class R>
SPLAT_FN R smallest(R a, R b) {
    return a < b ? a : b;
}
template <class R>
SPLAT_FN R magnitude(R a) {
    return a < 0 ? -a : a;
}
// Without a branch, so that R may be several numbers.
template <class R>
SPLAT_FN R either(bool yes, R a, R b) {
    return yes ? a : b;
}

// A 3 x 3 matrix by columns.
template <class R>
struct Mat {
    Vec<R> c0, c1, c2;
};
template <class R>
SPLAT_FN Vec<R> mul(const Mat<R>& m, Vec<R> v) {
    return v.x * m.c0 + v.y * m.c1 + v.z * m.c2;
}
template <class R>
SPLAT_FN Vec<R> mul_transposed(const Mat<R>& m, Vec<R> v) {
    return {dot(m.c0, v), dot(m.c1, v), dot(m.c2, v)};
}

// ---- camera

template <class R>
struct CameraModel {
    Mat<R> turn;    // world to camera
    Vec<R> shift;   // world to camera
    Vec<R> centre;  // in the world
    R fx, fy, cx, cy;
    R near;
    int width, height;
};

// ---- rotation

// Columns of the rotation of a unit quaternion w, x, y, z.
template <class R>
SPLAT_FN Mat<R> rotation(R w, R x, R y, R z) {
    return {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
            {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
            {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
}

// dL/d(quaternion of any length) from dL/d(rotation), g by columns.
template <class R>
SPLAT_FN void rotation_backward(const R q[4], R length, const Mat<R>& g, R out[4]) {
    const R w = q[0] / length, x = q[1] / length, y = q[2] / length, z = q[3] / length;
    const R g00 = g.c0.x, g10 = g.c0.y, g20 = g.c0.z, g01 = g.c1.x, g11 = g.c1.y, g21 = g.c1.z, g02 = g.c2.x,
            g12 = g.c2.y, g22 = g.c2.z;
    const R dw = 2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01));
    const R dx = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2 * x * (g11 + g22));
    const R dy = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2 * y * (g00 + g22));
    const R dz = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2 * z * (g00 + g11));
    const R along = w * dw + x * dx + y * dy + z * dz;
    out[0] = (dw - w * along) / length;
    out[1] = (dx - x * along) / length;
    out[2] = (dy - y * along) / length;
    out[3] = (dz - z * along) / length;
}

// ---- spherical harmonics

// Real spherical harmonics of degree <= 3 at a unit direction; `count` is 1, 4, 9 or 16.
template <class R>
SPLAT_FN void sh_basis(Vec<R> d, int count, R b[16]) {
    const R x = d.x, y = d.y, z = d.z;
    b[0] = R(0.28209479177387814);
    if (count < 4) return;
    b[1] = R(-0.4886025119029199) * y;
    b[2] = R(0.4886025119029199) * z;
    b[3] = R(-0.4886025119029199) * x;
    if (count < 9) return;
    const R xx = x * x, yy = y * y, zz = z * z;
    b[4] = R(1.0925484305920792) * x * y;
    b[5] = R(-1.0925484305920792) * y * z;
    b[6] = R(0.31539156525252005) * (2 * zz - xx - yy);
    b[7] = R(-1.0925484305920792) * x * z;
    b[8] = R(0.5462742152960396) * (xx - yy);
    if (count < 16) return;
    b[9] = R(-0.5900435899266435) * y * (3 * xx - yy);
    b[10] = R(2.890611442640554) * x * y * z;
    b[11] = R(-0.4570457994644658) * y * (4 * zz - xx - yy);
    b[12] = R(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy);
    b[13] = R(-0.4570457994644658) * x * (4 * zz - xx - yy);
    b[14] = R(1.445305721320277) * z * (xx - yy);
    b[15] = R(-0.5900435899266435) * x * (xx - 3 * yy);
}

// sum over k of w[k] d(basis k)/d(direction): the gradient of the polynomials above.
template <class R>
SPLAT_FN Vec<R> sh_backward(Vec<R> d, int count, const R w[16]) {
    Vec<R> g{0, 0, 0};
    if (count < 4) return g;
    const R x = d.x, y = d.y, z = d.z;
    g.y += R(-0.4886025119029199) * w[1];
    g.z += R(0.4886025119029199) * w[2];
    g.x += R(-0.4886025119029199) * w[3];
    if (count < 9) return g;
    const R c2 = R(1.0925484305920792), c20 = R(0.31539156525252005), c22 = R(0.5462742152960396);
    g.x += c2 * (y * w[4] - z * w[7]) - 2 * c20 * x * w[6] + 2 * c22 * x * w[8];
    g.y += c2 * (x * w[4] - z * w[5]) - 2 * c20 * y * w[6] - 2 * c22 * y * w[8];
    g.z += c2 * (-y * w[5] - x * w[7]) + 4 * c20 * z * w[6];
    if (count < 16) return g;
    const R xx = x * x, yy = y * y, zz = z * z;
    const R k9 = R(-0.5900435899266435) * w[9], k10 = R(2.890611442640554) * w[10],
            k11 = R(-0.4570457994644658) * w[11], k12 = R(0.3731763325901154) * w[12],
            k13 = R(-0.4570457994644658) * w[13], k14 = R(1.445305721320277) * w[14],
            k15 = R(-0.5900435899266435) * w[15];
    g.x += 6 * x * y * k9 + y * z * k10 - 2 * x * y * k11 - 6 * x * z * k12 + (4 * zz - 3 * xx - yy) * k13 +
           2 * x * z * k14 + 3 * (xx - yy) * k15;
    g.y += 3 * (xx - yy) * k9 + x * z * k10 + (4 * zz - xx - 3 * yy) * k11 - 6 * y * z * k12 - 2 * x * y * k13 -
           2 * y * z * k14 - 6 * x * y * k15;
    g.z += x * y * k10 + 8 * y * z * k11 + 3 * (2 * zz - xx - yy) * k12 + 8 * x * z * k13 + (xx - yy) * k14;
    return g;
}

// The direction in which a splat is seen that lies at d from the camera, how far away it is, and the harmonics there.
template <class R>
struct Sight {
    Vec<R> direction;
    R length, basis[16];
};
template <class R>
SPLAT_FN Sight<R> sight(Vec<R> d, int count) {
    Sight<R> o;
    o.length = square_root(dot(d, d));
    o.direction = (R(1) / largest(o.length, R(1e-30))) * d;
    sh_basis(o.direction, count, o.basis);
    return o;
}

// dL/d(mean) by the direction, from dL/d(basis); means nothing where the length is 0.
template <class R>
SPLAT_FN Vec<R> sight_backward(const Sight<R>& o, int count, const R w[16]) {
    const Vec<R> d = sh_backward(o.direction, count, w);
    return (R(1) / o.length) * (d - dot(d, o.direction) * o.direction);
}

// ---- one splat, its parts

template <class R>
struct SplatIn {
    Vec<R> mean;
    R quat[4];
    R scale[3];  // the third is unused by surfels
    R opacity;
};

template <class R>
struct SplatGrad {
    Vec<R> mean{0, 0, 0};
    R quat[4]{0, 0, 0, 0};
    R scale[3]{0, 0, 0};
    R opacity = 0;
    R signal[2]{0, 0};
};

// The region of the image in which alpha >= kAlphaMin: an ellipse about (mx, my) with the matrix (hxx, hxy, hyy), and a
// disc about (dx, dy) (surfels' low-pass filter; r2 < 0 if there is none). Pixels.
template <class R>
struct Bound {
    R mx, my, hxx, hxy, hyy;
    R dx, dy, r2;
};

// The squared distance in sigmas at which an opacity falls to kAlphaMin, and a little more.
template <class R>
SPLAT_FN auto cutoff(R opacity) {
    return 2 * natural_log(rough(opacity / R(kAlphaMin))) * rough(R(1.00001)) + rough(R(1e-5));
}

// Camera-frame quantities that the forward and the backward of both kinds share.
template <class R>
struct Posed {
    Vec<R> c;     // centre
    Mat<R> axes;  // columns of the rotation
    R length;     // of the quaternion
};

template <class R>
SPLAT_FN Posed<R> pose(const SplatIn<R>& s, const CameraModel<R>& cam) {
    Posed<R> p;
    p.c = mul(cam.turn, s.mean) + cam.shift;
    p.length =
        square_root(s.quat[0] * s.quat[0] + s.quat[1] * s.quat[1] + s.quat[2] * s.quat[2] + s.quat[3] * s.quat[3]);
    const Mat<R> r = rotation(s.quat[0] / p.length, s.quat[1] / p.length, s.quat[2] / p.length, s.quat[3] / p.length);
    p.axes = {mul(cam.turn, r.c0), mul(cam.turn, r.c1), mul(cam.turn, r.c2)};
    return p;
}

// dL/d(mean, quaternion) from dL/d(camera-frame centre and axes).
template <class R>
SPLAT_FN void pose_backward(const SplatIn<R>& s, const CameraModel<R>& cam, R length, Vec<R> dc, const Mat<R>& daxes,
                            SplatGrad<R>& out) {
    out.mean = mul_transposed(cam.turn, dc);
    const Mat<R> dr{mul_transposed(cam.turn, daxes.c0), mul_transposed(cam.turn, daxes.c1),
                    mul_transposed(cam.turn, daxes.c2)};
    rotation_backward(s.quat, length, dr, out.quat);
}

// ---- surfels

// Rows of the homography from the disc's (u, v, 1) to (x w, y w, w) (2DGS, eq. 7 f.).
template <class R>
struct Homography {
    Vec<R> u, v, w;
};

template <class R>
SPLAT_FN Homography<R> homography(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam) {
    const Vec<R> a = s.scale[0] * p.axes.c0, b = s.scale[1] * p.axes.c1, c = p.c;
    return {{cam.fx * a.x + cam.cx * a.z, cam.fx * b.x + cam.cx * b.z, cam.fx * c.x + cam.cx * c.z},
            {cam.fy * a.y + cam.cy * a.z, cam.fy * b.y + cam.cy * b.z, cam.fy * c.y + cam.cy * c.z},
            {a.z, b.z, c.z}};
}

// The box of the k-sigma contour: its centre, and f with centre = (f.(Tu Tw), f.(Tv Tw)). False, and the rest means
// nothing, if it meets the camera plane.
template <class R>
struct Contour {
    Vec<R> t, f;
    R d, x, y;
};
template <class R>
SPLAT_FN auto contour(const Homography<R>& h, R k_squared, Contour<R>& out) {
    out.t = {k_squared, k_squared, R(-1)};
    out.d = dot(out.t, times(h.w, h.w));
    out.f = (1 / out.d) * out.t;
    out.x = dot(out.f, times(h.u, h.w));
    out.y = dot(out.f, times(h.v, h.w));
    return out.d < R(0);
}

template <class R>
struct Surfel {
    Homography<R> h;
    Contour<R> low;  // 3 sigma: its centre is the low-pass filter's
    Vec<R> a, b, c;  // p = x a + y b + c about the anchor, divided by `unit`
    R unit, det;     // det of the homography / unit: z = det / p.z
    R ax, ay;        // anchor: a pixel centre near the splat, so that offsets stay small
    R z_low, z_high;
    R flip;  // sign that turns the normal to the camera
    Bound<R> bound;
};

// Project a surfel; false, and the rest means nothing, if nothing of it can be drawn.
template <class R>
SPLAT_FN auto surfel_project(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, Surfel<R>& o) {
    o.h = homography(s, p, cam);
    Contour<R> edge;
    const auto in_front = (p.c.z > cam.near) & (s.opacity > R(kAlphaMin)) & contour(o.h, R(kCutoffSquared), edge) &
                          contour(o.h, R(9), o.low);
    const auto k2 = smallest(cutoff(s.opacity), rough(R(kCutoffSquared)));
    const auto bounded = contour(o.h, R(k2), edge);
    o.bound = {edge.x,
               edge.y,
               edge.x * edge.x - dot(edge.f, times(o.h.u, o.h.u)),
               edge.x * edge.y - dot(edge.f, times(o.h.u, o.h.v)),
               edge.y * edge.y - dot(edge.f, times(o.h.v, o.h.v)),
               o.low.x,
               o.low.y,
               k2 / 2};
    const auto limit = rough(R(1 << 22)), near_x = rough(o.low.x), near_y = rough(o.low.y);
    o.ax = round_down(smallest(largest(near_x, -limit), limit)) + R(0.5);
    o.ay = round_down(smallest(largest(near_y, -limit), limit)) + R(0.5);
    const Vec<R> u = o.h.u - o.ax * o.h.w, v = o.h.v - o.ay * o.h.w;
    const Vec<R> a = cross(v, o.h.w), b = cross(o.h.w, u), c = cross(u, v);
    auto size = rough(R(0));
    const Vec<R> columns[3] = {a, b, c};
    for (const Vec<R>& q : columns)
        size = largest(size, largest(magnitude(rough(q.x)), largest(magnitude(rough(q.y)), magnitude(rough(q.z)))));
    o.unit = size;
    o.a = (1 / o.unit) * a;
    o.b = (1 / o.unit) * b;
    o.c = (1 / o.unit) * c;
    o.det = dot(u, a) / o.unit;
    // Seen edge-on, rays and disc share a plane and do not meet in a point: only the low-pass filter draws.
    const R lean = dot(p.axes.c2, p.c), none = R(0), one = R(1);
    const auto edge_on = lean * lean < R(kEdgeOn * kEdgeOn) * dot(p.c, p.c);
    o.a = {either(edge_on, none, o.a.x), either(edge_on, none, o.a.y), either(edge_on, none, o.a.z)};
    o.b = {either(edge_on, none, o.b.x), either(edge_on, none, o.b.y), either(edge_on, none, o.b.z)};
    o.c = {either(edge_on, one, o.c.x), either(edge_on, one, o.c.y), either(edge_on, none, o.c.z)};
    o.det = either(edge_on, none, o.det);
    const R reach = square_root(R(kCutoffSquared) * (o.h.w.x * o.h.w.x + o.h.w.y * o.h.w.y));
    o.z_low = largest(p.c.z - reach, cam.near);
    o.z_high = p.c.z + reach;
    o.flip = either(lean > none, R(-1), one);
    return in_front & bounded & (o.unit > none);
}

// How what one pixel hands back becomes its share of the screen-space gradient, in both directions: factors of q0 Y
// (q0 X for y), q0, q1 Y (q1 X), q1, dL/d(det), and, outside the disc, dL/d(rho / 2) times the offset from the low-pass
// centre. X, Y about the anchor, q the cotangents of p = X a + Y b + c.
template <class R>
struct SignalRow {
    R x[6], y[6];
};
template <class R>
SPLAT_FN SignalRow<R> surfel_signal(const CameraModel<R>& cam, const Surfel<R>& o) {
    const Vec<R> w = o.h.w, u = o.h.u - o.ax * w, v = o.h.v - o.ay * w;
    const R half_w = w.z * R(0.5) * R(cam.width), half_h = w.z * R(0.5) * R(cam.height);
    const R fx = half_w / o.unit, fy = half_h / o.unit, low = R(-2) * o.low.f.z * w.z;
    return {{fx * w.y, -fx * v.y, -fx * w.x, fx * v.x, fx * (v.x * w.y - v.y * w.x), half_w * low},
            {-fy * w.y, fy * u.y, fy * w.x, -fy * u.x, fy * (w.x * u.y - w.y * u.x), half_h * low}};
}

// What is drawn of a surfel: of Surfel and SignalRow what the pixels need, and the normal towards the camera.
template <class R>
struct SurfelView {
    Bound<R> bound;
    Vec<R> a, b, c;
    R det, z_low, z_high, ax, ay;
    Vec<R> normal;
    SignalRow<R> signal;
};
template <class R>
SPLAT_FN auto surfel_view(const SplatIn<R>& s, const CameraModel<R>& cam, SurfelView<R>& o) {
    const Posed<R> p = pose(s, cam);
    Surfel<R> q;
    const auto drawn = surfel_project(s, p, cam, q);
    o = {q.bound, q.a, q.b, q.c, q.det, q.z_low, q.z_high, q.ax, q.ay, q.flip * p.axes.c2, surfel_signal(cam, q)};
    return drawn;
}

// What the pixels hand back for a surfel: cotangents of a, b, c, det, the low-pass centre, colour, normal, opacity.
template <class R>
struct SurfelSums {
    Vec<R> a, b, c;
    R det;
    R low[2];
    Vec<R> normal;
    R opacity;
};

template <class R>
SPLAT_FN void surfel_backward(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, const Surfel<R>& o,
                              const SurfelSums<R>& g, SplatGrad<R>& out) {
    // u, v, w, a, b, c do not depend on `unit` up to a common factor, and the image does not depend on that factor.
    const R inv = 1 / o.unit;
    const Vec<R> w = o.h.w, u = o.h.u - o.ax * w, v = o.h.v - o.ay * w;
    const Vec<R> ga = inv * g.a, gb = inv * g.b, gc = inv * g.c;
    const R gdet = inv * g.det;
    Vec<R> du = cross(gb, w) + cross(v, gc) + gdet * cross(v, w);
    Vec<R> dv = cross(w, ga) + cross(gc, u) + gdet * cross(w, u);
    Vec<R> dw = cross(ga, v) + cross(u, gb) + gdet * cross(u, v) - o.ax * du - o.ay * dv;
    const Vec<R> df = g.low[0] * times(o.h.u, w) + g.low[1] * times(o.h.v, w);
    du = du + g.low[0] * times(o.low.f, w);
    dv = dv + g.low[1] * times(o.low.f, w);
    dw = dw + g.low[0] * times(o.low.f, o.h.u) + g.low[1] * times(o.low.f, o.h.v) -
         (2 * dot(df, o.low.f) / o.low.d) * times(o.low.t, w);
    const R half_w = w.z * R(0.5) * R(cam.width), half_h = w.z * R(0.5) * R(cam.height);
    out.signal[0] = du.z * half_w;
    out.signal[1] = dv.z * half_h;
    const Vec<R> da{cam.fx * du.x, cam.fy * dv.x, cam.cx * du.x + cam.cy * dv.x + dw.x};
    const Vec<R> db{cam.fx * du.y, cam.fy * dv.y, cam.cx * du.y + cam.cy * dv.y + dw.y};
    const Vec<R> dc{cam.fx * du.z, cam.fy * dv.z, cam.cx * du.z + cam.cy * dv.z + dw.z};
    out.scale[0] = dot(da, p.axes.c0);
    out.scale[1] = dot(db, p.axes.c1);
    out.scale[2] = 0;
    out.opacity = g.opacity;
    pose_backward(s, cam, p.length, dc, Mat<R>{s.scale[0] * da, s.scale[1] * db, o.flip * g.normal}, out);
}

// dL/d(surfel) but for its colour, from what its pixels hand back; of one that is drawn.
template <class R>
SPLAT_FN void surfel_gradient(const SplatIn<R>& s, const CameraModel<R>& cam, const SurfelSums<R>& g, SplatGrad<R>& out) {
    const Posed<R> p = pose(s, cam);
    Surfel<R> o;
    surfel_project(s, p, cam, o);
    surfel_backward(s, p, cam, o, g, out);
}

// ---- gaussians

// How gaussians are evaluated.
template <class R>
struct GaussianForm {
    R dilation;           // px^2, added to the footprint, which makes it at least about a pixel wide; not along rays
    bool is_compensated;  // whether the opacity is lowered by what that adds to the footprint
    Geometry geometry;
};

template <class R>
struct Gaussian {
    R x, y;              // projected centre, pixels
    R l00, l01, l11;     // rho = (l00 dx + l01 dy)^2 + (l11 dy)^2
    R compensation;      // factor on the opacity
    R slope_x, slope_y;  // depth per pixel
    R z, z_low, z_high;
    Vec<R> normal;
    int thin;  // the axis of the smallest scale
    R flip;
    R upright;  // length of the vector that the plane's normal is made of; 0 where the normal is an axis
    // Along rays rho is r / (u^2 + kappa r) and the depth z u / (u^2 + kappa r), with r that of the affine footprint,
    // u = 1 - slope . offset / z and 1 / kappa the camera's squared distance in sigmas. The normal is the direction of
    // -(steep + dx steep_x + dy steep_y).
    R kappa;
    Vec<R> steep, steep_x, steep_y;
    Bound<R> bound;
    // for the backward
    R cov[3], raw[2];  // footprint xx, xy, yy; xx and yy before dilation
    R jx, jy;          // x / z and y / z as the Jacobian sees them
    bool clamped_x, clamped_y;
};

template <class R>
SPLAT_FN R axis_scale(const SplatIn<R>& s, int k) {
    return s.scale[k];
}
template <class R>
SPLAT_FN Vec<R> column(const Mat<R>& m, int k) {
    return k == 0 ? m.c0 : k == 1 ? m.c1 : m.c2;
}

// Determinant of the footprint without dilation, by a sum of squares: nothing cancels in it.
template <class R>
SPLAT_FN R ray_footprint(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, R jx, R jy) {
    R det = 0, mx[3], my[3];
    for (int k = 0; k < 3; k++) {
        const Vec<R> r = column(p.axes, k);
        mx[k] = s.scale[k] * cam.fx / p.c.z * (r.x - jx * r.z);
        my[k] = s.scale[k] * cam.fy / p.c.z * (r.y - jy * r.z);
        for (int l = 0; l < k; l++) det += (mx[k] * my[l] - mx[l] * my[k]) * (mx[k] * my[l] - mx[l] * my[k]);
    }
    return det;
}

// What evaluation along rays adds to a gaussian, with the exact bound (GOF, section 4.1). False where the contour at
// the cutoff reaches the camera plane.
template <class R>
SPLAT_FN bool ray_project(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, R q, R smin, R k2,
                          Gaussian<R>& o) {
    const Vec<R> c = p.c;
    R deep = 0, tx = 0, ty = 0;
    o.steep = o.steep_x = o.steep_y = {0, 0, 0};
    for (int k = 0; k < 3; k++) {
        const Vec<R> r = column(p.axes, k);
        const R e = (smin / s.scale[k]) * (smin / s.scale[k]), size = s.scale[k] * s.scale[k];
        deep += size * r.z * r.z;
        tx += size * cam.fx * (r.x - o.jx * r.z) * r.z;
        ty += size * cam.fy * (r.y - o.jy * r.z) * r.z;
        o.steep = o.steep + (e * (r.x * o.jx + r.y * o.jy + r.z)) * r;
        o.steep_x = o.steep_x + (e * r.x / cam.fx) * r;
        o.steep_y = o.steep_y + (e * r.y / cam.fy) * r;
    }
    if (!(R(kCutoffSquared) * deep < c.z * c.z && q > 0)) return false;
    const R more = smallest(k2, R(kCutoffSquared)), rest = c.z * c.z - more * deep, mx = -more * tx / rest,
            my = -more * ty / rest, wide = more * c.z * c.z / rest;
    o.kappa = smin * smin / (c.z * c.z * q);
    o.bound = {o.x + mx, o.y + my, mx * mx + wide * o.cov[0], mx * my + wide * o.cov[1], my * my + wide * o.cov[2],
               o.x + mx, o.y + my, R(-1)};
    return true;
}

template <class R>
SPLAT_FN bool gaussian_project(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, const GaussianForm<R>& form,
                               Gaussian<R>& o) {
    const Vec<R> c = p.c;
    if (!(c.z > cam.near)) return false;
    const bool rays = form.geometry >= kRay;
    const R tan_x = R(0.5) * cam.width / cam.fx, tan_y = R(0.5) * cam.height / cam.fy;
    const R dx = c.x / c.z, dy = c.y / c.z;
    o.x = cam.fx * dx + cam.cx;
    o.y = cam.fy * dy + cam.cy;
    // Far outside the image the affine approximation explodes: the Jacobian is taken at the edge of a wider view.
    o.jx = smallest(largest(dx, -(cam.cx / cam.fx + R(0.3) * tan_x)), (cam.width - cam.cx) / cam.fx + R(0.3) * tan_x);
    o.jy = smallest(largest(dy, -(cam.cy / cam.fy + R(0.3) * tan_y)), (cam.height - cam.cy) / cam.fy + R(0.3) * tan_y);
    if (rays) o.jx = dx, o.jy = dy;
    o.clamped_x = o.jx != dx;
    o.clamped_y = o.jy != dy;
    R xx = 0, xy = 0, yy = 0, smin = s.scale[0], smax = s.scale[0];
    o.thin = 0;
    for (int k = 0; k < 3; k++) {
        const Vec<R> r = column(p.axes, k);
        const R mx = s.scale[k] * cam.fx / c.z * (r.x - o.jx * r.z),
                my = s.scale[k] * cam.fy / c.z * (r.y - o.jy * r.z);
        xx += mx * mx;
        xy += mx * my;
        yy += my * my;
        if (s.scale[k] < smin) smin = s.scale[k], o.thin = k;
        smax = largest(smax, s.scale[k]);
    }
    o.raw[0] = xx;
    o.raw[1] = yy;
    const R raw_det = rays ? ray_footprint(s, p, cam, dx, dy) : largest(xx * yy - xy * xy, R(0));
    const R dilation = rays ? R(0) : form.dilation;
    xx += dilation;
    yy += dilation;
    o.cov[0] = xx;
    o.cov[1] = xy;
    o.cov[2] = yy;
    // The dilation keeps the determinant away from 0; summing it apart avoids the cancellation in xx yy - xy xy.
    const R det = raw_det + dilation * (o.raw[0] + o.raw[1]) + dilation * dilation;
    if (!(det > 0)) return false;
    if (rays) {
        const R least = R(kMinFootprint) * R(kMinFootprint);
        if (!(least * largest(xx, yy) < det && least < smallest(xx, yy))) return false;
    }
    o.compensation = form.is_compensated ? square_root(largest(raw_det / det, R(kAntialiasFloor))) : R(1);
    const R opacity = s.opacity * o.compensation;
    if (!(opacity > R(kAlphaMin))) return false;
    o.l00 = square_root(yy / det);
    o.l01 = -xy / det / o.l00;
    o.l11 = 1 / square_root(yy);
    const R k2 = cutoff(opacity);
    o.bound = {o.x, o.y, k2 * xx, k2 * xy, k2 * yy, o.x, o.y, R(-1)};
    // Depth of the largest density along the ray, to first order about the centre (RaDe-GS).
    R q = 0;
    Vec<R> g{0, 0, 0};
    const Vec<R> d0{dx, dy, R(1)};
    for (int k = 0; k < 3; k++) {
        const R e = (smin / s.scale[k]) * (smin / s.scale[k]), h = dot(column(p.axes, k), d0);
        q += e * h * h;
        g = g + (e * h) * column(p.axes, k);
    }
    o.slope_x = q > 0 ? -c.z * g.x / q / cam.fx : R(0);
    o.slope_y = q > 0 ? -c.z * g.y / q / cam.fy : R(0);
    const R reach = square_root(R(kCutoffSquared)) * smax;
    o.z = c.z;
    o.z_low = largest(c.z - reach, cam.near);
    o.z_high = c.z + reach;
    o.normal = column(p.axes, o.thin);
    o.flip = dot(o.normal, c) > 0 ? R(-1) : R(1);
    o.normal = o.flip * o.normal;
    o.upright = 0;
    if (form.geometry == kPlane) {
        o.upright = square_root(dot(g, g));
        if (o.upright > 0) o.normal = (-1 / o.upright) * g;
    }
    return !rays || ray_project(s, p, cam, q, smin, k2, o);
}

// What the pixels hand back for a gaussian: moments of e = dL/d(power) about the centre, and the rest.
template <class R>
struct GaussianSums {
    R e_x, e_y, e_xx, e_xy, e_yy;
    R z, z_x, z_y;  // sums of dL/dz, and of it times the offset
    Vec<R> normal;
    R opacity;  // of the compensated opacity
    R along;    // sum of dL/d(slope . offset): that of dL/dz, except along rays
};

// What the pixels hand back for a gaussian along rays. e is of the affine footprint's power; its moments are by
// p = l00 dx + l01 dy and q = l11 dy.
template <class R>
struct RaySums {
    R e_p, e_q, e_pp, e_pq, e_qq;
    R z, u, u_x, u_y, kappa;  // z: of the factor z in the depth alone
    Vec<R> steep, steep_x, steep_y;
    R opacity;
};

// The same in terms of the depth plane z + slope . offset = z (2 - u).
template <class R>
SPLAT_FN GaussianSums<R> plane_sums(const Gaussian<R>& o, const RaySums<R>& g) {
    const R z = g.z + (o.slope_x * g.u_x + o.slope_y * g.u_y) / (o.z * o.z);
    const R a = o.l00, b = o.l01, c = o.l11, e_y = g.e_q / c, e_yy = g.e_qq / (c * c), e_py = g.e_pq / c;
    return {(g.e_p - b * e_y) / a,
            e_y,
            (g.e_pp - 2 * b * e_py + b * b * e_yy) / (a * a),
            (e_py - b * e_yy) / a,
            e_yy,
            z,
            -g.u_x / o.z,
            -g.u_y / o.z,
            {0, 0, 0},
            g.opacity,
            -g.u / o.z};
}

template <class R>
SPLAT_FN void gaussian_backward(const SplatIn<R>& s, const Posed<R>& p, const CameraModel<R>& cam, const GaussianForm<R>& form,
                                const Gaussian<R>& o, const GaussianSums<R>& g, const RaySums<R>* ray,
                                SplatGrad<R>& out) {
    const Vec<R> c = p.c;
    const R qa = o.l00 * o.l00, qb = o.l00 * o.l01, qc = o.l01 * o.l01 + o.l11 * o.l11;
    const R mean_x = qa * g.e_x + qb * g.e_y - o.slope_x * g.along,
            mean_y = qb * g.e_x + qc * g.e_y - o.slope_y * g.along;
    out.signal[0] = mean_x * R(0.5) * cam.width;
    out.signal[1] = mean_y * R(0.5) * cam.height;
    // dL/d(footprint) = -Q G Q with G = -1/2 sum e d d^T.
    const R gxx = R(-0.5) * g.e_xx, gxy = R(-0.5) * g.e_xy, gyy = R(-0.5) * g.e_yy;
    const R txx = qa * gxx + qb * gxy, txy = qa * gxy + qb * gyy, tyx = qb * gxx + qc * gxy, tyy = qb * gxy + qc * gyy;
    R dxx = -(txx * qa + txy * qb), dxy = -(txx * qb + txy * qc), dyy = -(tyx * qb + tyy * qc);
    out.opacity = g.opacity * o.compensation;
    if (form.is_compensated) {
        const R det = qa > 0 ? o.cov[2] / qa : R(1), raw_det = largest(o.raw[0] * o.raw[1] - o.cov[1] * o.cov[1], R(0));
        if (raw_det / det > R(kAntialiasFloor)) {
            const R dratio = g.opacity * s.opacity / (2 * o.compensation), d0 = dratio / det,
                    d1 = -dratio * raw_det / det / det;
            dxx += d0 * o.raw[1] + d1 * o.cov[2];
            dyy += d0 * o.raw[0] + d1 * o.cov[0];
            dxy += -(d0 + d1) * o.cov[1];
        }
    }
    Vec<R> dc{0, 0, 0};
    Mat<R> daxes{{0, 0, 0}, {0, 0, 0}, {0, 0, 0}};
    Vec<R>* columns[3] = {&daxes.c0, &daxes.c1, &daxes.c2};
    const R fz_x = cam.fx / c.z, fz_y = cam.fy / c.z;
    R dj00 = 0, dj02 = 0, dj11 = 0, dj12 = 0;
    for (int k = 0; k < 3; k++) {
        const Vec<R> r = column(p.axes, k);
        const R vx = fz_x * (r.x - o.jx * r.z), vy = fz_y * (r.y - o.jy * r.z);
        const R gx = 2 * s.scale[k] * (dxx * vx + dxy * vy), gy = 2 * s.scale[k] * (dxy * vx + dyy * vy);
        out.scale[k] = gx * vx + gy * vy;
        const R hx = s.scale[k] * gx, hy = s.scale[k] * gy;
        *columns[k] = {hx * fz_x, hy * fz_y, -hx * fz_x * o.jx - hy * fz_y * o.jy};
        dj00 += hx * r.x;
        dj02 += hx * r.z;
        dj11 += hy * r.y;
        dj12 += hy * r.z;
    }
    const R zz = c.z * c.z;
    dc.z += -cam.fx / zz * dj00 - cam.fy / zz * dj11;
    // J02 = -fx jx / z with jx = x / z, or a constant where clamped.
    dc.z += cam.fx * o.jx / zz * dj02 + cam.fy * o.jy / zz * dj12;
    if (!o.clamped_x) dc.x += -cam.fx / zz * dj02, dc.z += cam.fx * o.jx / zz * dj02;
    if (!o.clamped_y) dc.y += -cam.fy / zz * dj12, dc.z += cam.fy * o.jy / zz * dj12;
    dc.x += fz_x * mean_x;
    dc.y += fz_y * mean_y;
    dc.z += -(fz_x * c.x * mean_x + fz_y * c.y * mean_y) / c.z + g.z;
    // The depth plane.
    R smin = s.scale[o.thin], q = 0;
    const Vec<R> d0{c.x / c.z, c.y / c.z, R(1)};
    R e[3], h[3];
    Vec<R> G{0, 0, 0};
    for (int k = 0; k < 3; k++) {
        e[k] = (smin / s.scale[k]) * (smin / s.scale[k]);
        h[k] = dot(column(p.axes, k), d0);
        q += e[k] * h[k] * h[k];
        G = G + (e[k] * h[k]) * column(p.axes, k);
    }
    if (q > 0) {
        G = (1 / q) * G;
        const Vec<R> dG{-c.z / cam.fx * g.z_x, -c.z / cam.fy * g.z_y, 0};
        dc.z += -(G.x / cam.fx * g.z_x + G.y / cam.fy * g.z_y);
        const R phi = dot(G, dG);
        Vec<R> dd0{0, 0, 0};
        for (int k = 0; k < 3; k++) {
            const Vec<R> r = column(p.axes, k);
            const R along = dot(r, dG), dh = e[k] * (along - 2 * phi * h[k]) / q, de = h[k] * (along - phi * h[k]) / q;
            out.scale[k] += -2 * e[k] / s.scale[k] * de;
            *columns[k] = *columns[k] + (e[k] * h[k] / q) * dG + dh * d0;
            dd0 = dd0 + dh * r;
        }
        dc.x += dd0.x / c.z;
        dc.y += dd0.y / c.z;
        dc.z += -(dd0.x * c.x + dd0.y * c.y) / zz;
    }
    if (ray) {
        for (int k = 0; k < 3; k++) {
            const Vec<R> r = column(p.axes, k);
            // W r and W^T r with W = sum of dL/d(steep at the pixel) (ray)^T.
            const Vec<R> wr = h[k] * ray->steep + (r.x / cam.fx) * ray->steep_x + (r.y / cam.fy) * ray->steep_y;
            const R ts = dot(r, ray->steep);
            const Vec<R> wtr =
                ts * d0 + Vec<R>{dot(r, ray->steep_x) / cam.fx, dot(r, ray->steep_y) / cam.fy, R(0)};
            const R dk = ray->kappa * o.kappa * 2 * e[k] * h[k] / q;
            *columns[k] = *columns[k] + e[k] * (wr + wtr) - dk * d0;
            out.scale[k] += (dk * h[k] - 2 * e[k] * dot(r, wr)) / s.scale[k];
            dc.x -= dk * r.x / c.z;
            dc.y -= dk * r.y / c.z;
            dc.z += dk * (r.x * c.x + r.y * c.y) / zz;
        }
        dc.z -= 2 * ray->kappa * o.kappa / c.z;
    } else if (o.upright > 0) {
        // The normal is -g / |g| with g the sum of e h r, whose length says nothing.
        const Vec<R> t = (-1 / o.upright) * (g.normal - dot(g.normal, o.normal) * o.normal);
        for (int k = 0; k < 3; k++) {
            const Vec<R> r = column(p.axes, k);
            const R along = dot(r, t), dh = e[k] * along;
            out.scale[k] -= 2 * e[k] / s.scale[k] * h[k] * along;
            *columns[k] = *columns[k] + (e[k] * h[k]) * t + dh * d0;
            dc.x += dh * r.x / c.z;
            dc.y += dh * r.y / c.z;
            dc.z -= dh * (r.x * c.x + r.y * c.y) / zz;
        }
    } else {
        *columns[o.thin] = *columns[o.thin] + o.flip * g.normal;
    }
    pose_backward(s, cam, p.length, dc, daxes, out);
}

// ---- tiles and rows

// What of a bound does not change from line to line.
template <class R>
struct Outline {
    R hx, hy;  // half sides of the ellipse's box
    R tilt;    // x of the ellipse's middle, per line
    R wide;    // square of its half width on the line through its centre
    R turn;    // the right-most point's ordinate
};
template <class R>
SPLAT_FN Outline<R> outline(const Bound<R>& b) {
    const R hx = square_root(b.hxx), tilt = b.hxy / b.hyy;
    return {hx, square_root(b.hyy), tilt, largest(b.hxx - b.hxy * tilt, R(0)), b.hxy / hx};
}

// The pixels x in [low, high] of the bound on the lines y0 <= y <= y1; false if there are none.
template <class R>
SPLAT_FN bool bound_span(const Bound<R>& b, const Outline<R>& o, R y0, R y1, R& low, R& high) {
    bool any = false;
    const R a = largest(y0 - b.my, -o.hy), z = smallest(y1 - b.my, o.hy);
    if (a <= z) {
        const R right = smallest(largest(o.turn, a), z), left = smallest(largest(-o.turn, a), z);
        high = b.mx + o.tilt * right + square_root(largest(o.wide * (1 - right * right / b.hyy), R(0)));
        low = b.mx + o.tilt * left - square_root(largest(o.wide * (1 - left * left / b.hyy), R(0)));
        any = true;
    }
    if (b.r2 > 0) {
        const R near_y = smallest(largest(b.dy, y0), y1) - b.dy, left = b.r2 - near_y * near_y;
        if (left >= 0) {
            const R half = square_root(left);
            low = any ? smallest(low, b.dx - half) : b.dx - half;
            high = any ? largest(high, b.dx + half) : b.dx + half;
            any = true;
        }
    }
    return any;
}

// ---- per pixel

// rho of a surfel and its depth at (x, y) about the anchor. `on_disc` where the ray meets the disc nearer than the
// low-pass filter, `free_z` where the depth is not clamped. u, v, inv are only meaningful on the disc, inv where
// free_z.
template <class V>
struct SurfelHit {
    V u, v, inv, rho, z, dx, dy;
};
template <class V, class S, class M>
SPLAT_FN SurfelHit<V> surfel_hit(const S& s, V x, V y, M& on_disc) {
    SurfelHit<V> o;
    const V px = madd(x, s.a[0], madd(y, s.b[0], s.c[0])), py = madd(x, s.a[1], madd(y, s.b[1], s.c[1])),
            pz = madd(x, s.a[2], madd(y, s.b[2], s.c[2]));
    o.inv = reciprocal(pz);
    o.u = px * o.inv;
    o.v = py * o.inv;
    const V disc = madd(o.u, o.u, o.v * o.v);
    o.dx = x - s.low_x;
    o.dy = y - s.low_y;
    const V low = madd(o.dx, o.dx, o.dy * o.dy);
    const V low_rho = low + low;
    on_disc = less_equal(disc, low_rho);
    o.rho = select(on_disc, disc, low_rho);
    return o;
}
template <class V, class S, class M>
SPLAT_FN V surfel_depth(const S& s, const SurfelHit<V>& hit, M& free_z) {
    const V z = s.det * hit.inv;
    free_z = less_equal(s.z_low, z) & less_equal(z, s.z_high);
    return select(free_z, z, select(less_equal(s.z_high, z), s.z_high, s.z_low));
}

}  // namespace splat
