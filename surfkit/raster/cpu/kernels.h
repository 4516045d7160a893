// What the per-pixel kernels read and write, and the table through which one of their compilations is chosen.
#pragma once

#include <cstdint>

namespace surfkit {

constexpr int kTile = 16;  // pixels

// A tile's entry: which record it draws, and which slot its gradient goes to.
struct Entry {
    uint32_t record, slot;
};

// What blending needs of a surfel; lengths in pixels about the anchor (ax, ay), which is a pixel centre.
struct alignas(64) SurfelRecord {
    double a[3], b[3], c[3];  // double so that the origin moves to each tile without loss
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

// Images, row by row; null where not wanted. Planes of colour and normal follow one another.
struct Planes {
    float *color, *alpha, *depth, *median, *normal, *distortion;
};

// What the forward keeps for the backward, each a plane of H x W.
struct Saved {
    float* open;               // transmittance at the end
    int32_t* last;             // index in the tile's list of the last splat blended, -1 if none
    int32_t* middle;           // the same of the median depth
    float *m_shift, *m1, *m2;  // inverse depth of the first splat, and moments about it
    uint64_t* blocks;          // per entry, the blocks of the tile that it was blended into; zero to begin with
};

struct Job {
    int width, height, tiles_x, tiles_y;
    const void* records;
    const Entry* entries;
    const int64_t* offsets;  // tiles + 1
    const int64_t* index;    // the splat of each record
    int64_t rows;            // splats from this one on get no gradient
};

enum Kind { kSurfel = 0, kGaussian = 1 };
// Which maps a pass has to do with.
enum Level { kColor = 0, kGeometry = 1, kDistortion = 2 };
// What is said of the chosen losses: nothing, cotangents of colour, cotangents of every map; and of every map where the
// shares of the pixels are summed without their signs.
enum Chosen { kNone = 0, kChosenColor = 1, kChosenAll = 2, kChosenAbsolute = 3 };

constexpr int kSurfelSums = 20, kSurfelSumsChosen = 24;
constexpr int kGaussianSums = 16, kGaussianSumsChosen = 20;

// Normals of the splats against those of a depth map: inputs, and where the gradients go. Planes of width x height; the
// gradient by the depths is left as what each pixel sends to its four neighbours.
struct NormalJob {
    const float *depth, *alpha, *normal;
    int width, height;
    float fx, fy, cx, cy, scale;
    float *d_normal, *to_right, *to_left, *to_below, *to_above;
};

// Points in a tile in the order of their depths, kProbes of them or a multiple of it; x and y in pixels from the tile's
// centre. `open` begins with 1.
constexpr int kProbes = 16;
struct Probes {
    int64_t count;
    const float *x, *y, *z;
    float* open;
};

struct Kernels {
    const char* name;
    void (*forward)(Kind, Level, const Job&, int64_t tile, const Planes& out, const Saved&);
    // `sums` has one row of floats per slot; `touched` one byte per slot, set where the row was written.
    void (*backward)(Kind, Level, Chosen, const Job&, int64_t tile, const Planes& total, const Planes& chosen,
                     const Saved&, float* sums, uint8_t* touched);
    // Sum and count per slot of alpha^a T^b.
    void (*contribution)(Kind, const Job&, int64_t tile, float alpha_power, float open_power, float* sums,
                         uint8_t* touched);
    // What is left open of the rays to points in a tile.
    void (*probe)(Kind, const Job&, int64_t tile, const Probes&);
    // Rows [y0, y1) of one plane: SSIM summed, and its three partial-derivative planes.
    double (*ssim_rows)(const float* x, const float* y, int width, int height, int y0, int y1, float* d_mean,
                        float* d_square, float* d_cross);
    void (*ssim_gradient_rows)(const float* x, const float* y, const float* d_mean, const float* d_square,
                               const float* d_cross, int width, int height, int y0, int y1, float scale, float* out);
    // Sum of 1 - alpha (normal . normal of the depth) over the inner pixels of rows [y0, y1) that have one.
    double (*normal_rows)(const NormalJob&, int y0, int y1);
    void (*adam)(int64_t count, float* value, const float* gradient, float* first, float* second, float rate,
                 float share1, float share2, float second_correction, float epsilon);
};

const Kernels& kernels_avx512();
const Kernels& kernels_avx2();
const Kernels& kernels_baseline();

}  // namespace surfkit
