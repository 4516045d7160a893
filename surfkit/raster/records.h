// What blending needs of one splat in one view, by its kind; for every backend. The including file gives Real: a number
// more exact than float.
#pragma once

namespace surfkit {

constexpr int kTile = 16;  // pixels

enum Kind { kSurfel = 0, kGaussian = 1, kGaussianRay = 2 };
// Which maps a pass has to do with.
enum Level { kColor = 0, kGeometry = 1, kDistortion = 2 };
// What is said of the chosen losses: nothing, cotangents of colour, cotangents of every map; and of every map where the
// shares of the pixels are summed without their signs.
enum Chosen { kNone = 0, kChosenColor = 1, kChosenAll = 2, kChosenAbsolute = 3 };

constexpr int kSurfelSums = 20, kSurfelSumsChosen = 24;
constexpr int kGaussianSums = 16, kGaussianSumsChosen = 20;
constexpr int kRaySums = 24, kRaySumsChosen = 28;

// What blending needs of a surfel; lengths in pixels about the anchor (ax, ay), which is a pixel centre.
struct alignas(64) SurfelRecord {
    Real a[3], b[3], c[3];  // so exact that the origin moves to each tile without loss
    float det, z_low, z_high;
    float opacity, color[3], normal[3];
    float ax, ay;
    // the bound about the anchor, for rows: x = mx + tilt dy +- sqrt(wide (1 - dy^2 flat)); the disc is the low-pass
    // filter's
    float mx, my, tilt, wide, flat, disc_x, disc_y, disc_r2;
    float signal_x[6], signal_y[3];  // of the SignalRow: x, and the entries 1, 3 and 4 of y; the others follow from x
};

struct alignas(64) GaussianRecord {
    float x, y, l00, l01, l11;
    float z, slope_x, slope_y, z_low, z_high;
    float opacity, color[3], normal[3];
    float ax, ay;
    float mx, my, tilt, wide, flat, disc_x, disc_y, disc_r2;
};

// A gaussian along rays; see splat::Gaussian.
struct alignas(64) RayRecord {
    float x, y, l00, l01, l11;
    float z, z_low, z_high;
    float bend_x, bend_y, kappa;  // u = 1 + bend . offset
    float steep[3], steep_x[3], steep_y[3];
    float opacity, color[3];
    float ax, ay;
    float mx, my, tilt, wide, flat, disc_x, disc_y, disc_r2;
};

}  // namespace surfkit
