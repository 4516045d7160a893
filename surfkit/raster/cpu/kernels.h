// What the per-pixel kernels read and write, and the table through which one of their compilations is chosen.
#pragma once

#include <cstdint>

#include "doubles.h"
#include "../records.h"
#include "../splat_math.h"

namespace surfkit {

// A tile's entry: which record it draws, and which slot its gradient goes to.
struct Entry {
    uint32_t record, slot;
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
    float *solid, *fall;       // depth of solids, and how fast the light falls there, of its logarithm; 0 for no gradient
    uint64_t* blocks;          // per entry, the blocks of the tile that it was blended into; zero to begin with
};

// Activated values of N splats, as in raster/api.py; `scales` has 2 or 3 columns by the kind.
struct SplatArrays {
    int64_t count;
    int coefficients;  // of spherical harmonics, per channel
    const float *means, *quats, *scales, *opacities;
    const float *sh0, *sh_rest;  // the first coefficient, and the others
};

struct Job {
    int width, height, tiles_x, tiles_y;
    const void* records;
    const Entry* entries;
    const int64_t* offsets;  // tiles + 1
    const int64_t* index;    // the splat of each record
    int64_t rows;            // splats from this one on get no gradient
};

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

// An ellipsoid for rays that are evaluated in space, in units of its axes: the direction of the ray through the pixel
// position (x, y), with z = 1, is x r[0] + y r[1] + r[2], and `o` is the camera, from the centre.
struct RaySplat {
    double r[3][3], o[3];
    float opacity, z_low;  // nearer than z_low it hides nothing
};

struct Kernels {
    const char* name;
    void (*forward)(Kind, Level, const Job&, int64_t tile, const Planes& out, const Saved&);
    // `sums` has one row of floats per slot; `touched` one byte per slot, set where the row was written.
    void (*backward)(Kind, Level, Chosen, const Job&, int64_t tile, const Planes& total, const Planes& chosen,
                     const Saved&, float* sums, uint8_t* touched);
    // After `forward`, of gaussians along rays: the median depth becomes that of stochastic solids; where it is nearer
    // than `near` there is none. After `backward`: adds what that depth hands back to the same sums.
    void (*solid)(const Job&, int64_t tile, float near, const Planes& out, const Saved&);
    void (*solid_backward)(Chosen, const Job&, int64_t tile, const Planes& total, const Planes& chosen, const Saved&,
                           float* sums, uint8_t* touched);
    // Sum and count per slot of alpha^a T^b.
    void (*contribution)(Kind, const Job&, int64_t tile, float alpha_power, float open_power, float* sums,
                         uint8_t* touched);
    // Adds to each slot the pixels in which its splat has the largest weight and the median depth.
    void (*leading)(Kind, const Job&, int64_t tile, uint32_t* counts);
    // What is left open of the rays to points in a tile.
    void (*probe)(Kind, const Job&, int64_t tile, const Probes&);
    // The same of `count` ellipsoids that are evaluated in space, as stochastic solids or by the largest density;
    // (ox, oy): the tile's centre.
    void (*ray_probe)(bool solid, const RaySplat* splats, const uint32_t* rows, int64_t count, double ox, double oy,
                      float near, const Probes&);
    // Rows [y0, y1) of one plane: SSIM summed, and its three partial-derivative planes.
    double (*ssim_rows)(const float* x, const float* y, int width, int height, int y0, int y1, float* d_mean,
                        float* d_square, float* d_cross);
    void (*ssim_gradient_rows)(const float* x, const float* y, const float* d_mean, const float* d_square,
                               const float* d_cross, int width, int height, int y0, int y1, float scale, float* out);
    // Sum of 1 - alpha (normal . normal of the depth) over the inner pixels of rows [y0, y1) that have one.
    double (*normal_rows)(const NormalJob&, int y0, int y1);
    // Project the surfels of some rows; `drawn` tells which of `out` mean something. And the gradients of surfels that are
    // drawn but for their colours, from the sums over their pixels, `stride` numbers apart.
    void (*project_surfels)(const SplatArrays&, const int64_t* rows, int64_t count, const splat::CameraModel<double>&,
                            splat::SurfelView<double>* out, bool* drawn);
    void (*surfels_backward)(const SplatArrays&, const int64_t* rows, int64_t count, const splat::CameraModel<double>&,
                             const double* sums, int stride, splat::SplatGrad<double>* out);
    // Writes the tiles that a bound touches (`each_tile`), at most tiles_x * tiles_y; their number.
    int (*tiles)(const splat::Bound<double>&, int tiles_x, int tiles_y, double rim, uint32_t* to);
    // Colours of the splats of some rows, below 0 too. And the gradients of their coefficients (1, 4, 9 or 16 of them),
    // and what is added to those of their means, from `rgb`, the sums over their pixels, `stride` numbers apart.
    void (*shade)(const SplatArrays&, const int64_t* rows, int64_t count, const splat::CameraModel<double>&,
                  double (*rgb)[3]);
    void (*shade_backward)(const SplatArrays&, const int64_t* rows, int64_t count, const splat::CameraModel<double>&,
                           const double* rgb, int stride, float* out_sh0, float* out_sh_rest,
                           splat::SplatGrad<double>* out);
    // Adds up those of `count` rows of `width` numbers, a multiple of 4, that are touched; whether one is.
    bool (*add_rows)(const float* rows, const uint8_t* touched, int64_t count, int width, double* sums);
    void (*adam)(int64_t count, float* value, const float* gradient, float* first, float* second, float rate,
                 float share1, float share2, float second_correction, float epsilon);
    // The same for `count` rows of `wide` numbers, whose second moments are first multiplied by `kept`; kept and gradient
    // have these rows alone.
    void (*adam_rows)(const int64_t* rows, int64_t count, int64_t wide, const float* kept, float* value,
                      const float* gradient, float* first, float* second, float rate, float share1, float share2,
                      float second_correction, float epsilon);
    // Both with moments in 16 bits, rounded as train/moments.py says. `rows` and `kept` may be none: for all rows then.
    // The values begin at `origin` of their column.
    void (*adam_short)(const int64_t* rows, int64_t count, int64_t wide, const float* kept, float* value,
                       const float* gradient, uint16_t* first, uint16_t* second, int64_t origin, uint32_t step,
                       float rate, float share1, float share2, float second_correction, float epsilon);
};

const Kernels& kernels_avx512();
const Kernels& kernels_avx2();
const Kernels& kernels_baseline();

}  // namespace surfkit
