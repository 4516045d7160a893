// What all kernels of the rasterizer take: the kind of splats that it is compiled for, and the view.
//
// KIND, LEVEL and CHOSEN are defined by raster/cuda/rasterizer.py: see `Kind`, `Level` and `Chosen` in ../records.h. So
// are COEFFICIENTS, of spherical harmonics per channel, and WIDTH, floats in a row of sums.
#pragma once

#include "scalar.h"
#include "../pixels.h"
#include "../project.h"

namespace surfkit {

#if KIND == 0
typedef Surfels Splat;
#elif KIND == 1
typedef Gaussians Splat;
#else
typedef Rays Splat;
#endif
typedef Splat::Record SplatRecord;

constexpr Kind kKind = (Kind)KIND;
constexpr int kColumns = kKind == kSurfel ? 2 : 3;
constexpr int kThreads = kTile * kTile;  // of a block that draws a tile: a thread for each pixel
constexpr int kWarps = kThreads / 32;
constexpr int kStrip = 8, kRows = 4;  // pixels of a warp

struct View {
    CameraModel<Pair> camera;
    Outlook<float> outlook;
    GaussianForm form;
    float rim;
    int tiles_x, tiles_y;
};

inline Vec<float> rounded(Vec<Pair> v) { return {(float)v.x, (float)v.y, (float)v.z}; }

#ifdef COEFFICIENTS
// Activated values of splats, as in raster/api.py.
struct Arrays {
    Buffer<const float> means, quats, scales, opacities, sh0, sh_rest;
    static constexpr int coefficients = COEFFICIENTS;
};
typedef splat::Sight<float> Sight;
inline Sight sight(const View& view, const SplatIn<Pair>& in) {
    return splat::sight(rounded(in.mean - view.camera.centre), COEFFICIENTS);
}
typedef Tint<float> SplatTint;
// `record` keeps the tints for the way back where they are less to read than the harmonics.
constexpr bool kKeepsTints = COEFFICIENTS > 4;
#endif

// A splat of a tile's list: which record draws it, and which row of sums its gradient goes to.
struct Entry {
    int record, slot;
};

// Where the thread's pixel lies: a warp has 8 x 4 of them, so that one test tells whether a splat touches any.
struct Pixel {
    int tile, x, y;
    float dx, dy;     // from the tile's centre
    float left, top;  // of the warp's pixels, the same way
    bool is_inside;
    long long at, plane;  // in an image, and its size

    explicit Pixel(const View& view) {
        const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
        tile = blockIdx.x;
        const int column = warp % 2 * kStrip, row = warp / 2 * kRows;
        const float middle = (kTile - 1) / 2.0f;
        left = column - middle;
        top = row - middle;
        dx = left + lane % kStrip;
        dy = top + lane / kStrip;
        x = tile % view.tiles_x * kTile + column + lane % kStrip;
        y = tile / view.tiles_x * kTile + row + lane / kStrip;
        is_inside = x < view.camera.width && y < view.camera.height;
        plane = (long long)view.camera.width * view.camera.height;
        at = (long long)y * view.camera.width + x;
    }
};

// A record as a tile sees it, in shared memory.
struct Staged {
    Splat::Local local;
#if KIND == 2
    float steep[3], steep_x[3], steep_y[3];
#else
    float normal[3];
#endif
    float color[3];
};
// Where it may be drawn, in shared memory too.
struct Reach {
    Bound<float> bound;  // about the tile's centre
    Outline<float> outline;
};

// The tile's centre, less the splat's anchor.
inline float from_anchor_x(const View& view, int tile, const SplatRecord& r) {
    return tile % view.tiles_x * kTile + kTile / 2.0f - r.ax;
}
inline float from_anchor_y(const View& view, int tile, const SplatRecord& r) {
    return tile / view.tiles_x * kTile + kTile / 2.0f - r.ay;
}

inline Staged stage(const View& view, int tile, const SplatRecord& r) {
    const float sx = from_anchor_x(view, tile, r), sy = from_anchor_y(view, tile, r);
    Staged o;
    o.local = Splat::Local::of(r, sx, sy);
    for (int c = 0; c < 3; c++) {
        o.color[c] = r.color[c];
#if KIND == 2
        o.steep[c] = r.steep[c];
        o.steep_x[c] = r.steep_x[c];
        o.steep_y[c] = r.steep_y[c];
#else
        o.normal[c] = r.normal[c];
#endif
    }
    return o;
}

// (sx, sy): what it is to be about, less the splat's anchor. Not by `outline`: of a long and thin ellipse it would lose
// the width, which the record has.
inline Reach reach(const SplatRecord& r, float sx, float sy) {
    const float hyy = 1 / r.flat, hxy = r.tilt * hyy, hxx = r.wide + r.tilt * hxy, hx = square_root(hxx);
    return {{r.mx - sx, r.my - sy, hxx, hxy, hyy, r.disc_x - sx, r.disc_y - sy, r.disc_r2},
            {hx, square_root(hyy), r.tilt, r.wide, hxy / hx}};
}
inline Reach reach(const View& view, int tile, const SplatRecord& r) {
    return reach(r, from_anchor_x(view, tile, r), from_anchor_y(view, tile, r));
}

// Whether a splat may touch one of the warp's pixels.
inline bool touches(const Reach& s, const Pixel& p) {
    float low, high;
    const float slack = 2e-3f;  // the bound is in float here
    return splat::bound_span(s.bound, s.outline, p.top - slack, p.top + kRows - 1 + slack, low, high) &&
           low <= p.left + kStrip - 1 + slack && p.left - slack <= high;
}

}  // namespace surfkit
