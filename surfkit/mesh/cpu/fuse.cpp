// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table. Plain loops over one layer of a
// block, which compilers turn into vectors; without contraction, so that all three give the same bits.
#include "fuse.h"

#include <algorithm>

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(fuse_kernels_, name)

namespace surfkit {
namespace {

constexpr int kLayer = kSide * kSide;

struct Samples {
    alignas(64) float z[kLayer], at_x[kLayer], at_y[kLayer], depth[kLayer], slant[kLayer];
    alignas(64) float corner[4][kLayer];
    alignas(64) int32_t pixel[kLayer], left[kLayer], right[kLayer], above[kLayer], below[kLayer];
    alignas(64) uint32_t shade[kLayer];
    alignas(64) int32_t inside[kLayer];
};

// Where each voxel of a layer falls in the picture.
inline bool project(const FuseJob& job, const float* first, int layer, Samples& s) {
    const float *ox = job.offsets[0] + layer * kLayer, *oy = job.offsets[1] + layer * kLayer,
                *oz = job.offsets[2] + layer * kLayer;
    int some = 0;
    for (int i = 0; i < kLayer; i++) {
        const Place p = place(job.lens, first[0] + ox[i], first[1] + oy[i], first[2] + oz[i]);
        s.z[i] = p.z;
        s.inside[i] = p.inside;
        s.pixel[i] = p.pixel;
        s.at_x[i] = p.at_x;
        s.at_y[i] = p.at_y;
        s.left[i] = p.left;
        s.right[i] = p.right;
        s.above[i] = p.above;
        s.below[i] = p.below;
        some |= p.inside;
    }
    return some != 0;
}

// The depth of the pixel that each voxel falls on. Neighbours are asked only where they can matter.
inline void gather(const FuseJob& job, Samples& s, bool& some, bool& close) {
    for (int i = 0; i < kLayer; i++) s.depth[i] = job.depth[s.pixel[i]];
    for (int i = 0; i < kLayer; i++) s.slant[i] = job.slant[s.pixel[i]];
    int32_t before = 0, near = 0;
    for (int i = 0; i < kLayer; i++) {
        const int32_t counts = s.inside[i] & may_count(job.band, s.depth[i], s.z[i], s.slant[i]);
        s.inside[i] = counts;
        before |= counts;
        near |= counts & may_be_near(job.band, s.depth[i], s.z[i], s.slant[i]);
    }
    some = before != 0;
    close = near != 0;
}

inline void gather_neighbours(const FuseJob& job, Samples& s) {
    for (int i = 0; i < kLayer; i++) s.corner[0][i] = job.depth[s.above[i] + s.left[i]];
    for (int i = 0; i < kLayer; i++) s.corner[1][i] = job.depth[s.above[i] + s.right[i]];
    for (int i = 0; i < kLayer; i++) s.corner[2][i] = job.depth[s.below[i] + s.left[i]];
    for (int i = 0; i < kLayer; i++) s.corner[3][i] = job.depth[s.below[i] + s.right[i]];
}

inline void interpolate(const FuseJob& job, Samples& s) {
    for (int i = 0; i < kLayer; i++)
        s.depth[i] = between(job.band, s.corner[0][i], s.corner[1][i], s.corner[2][i], s.corner[3][i], s.at_x[i],
                             s.at_y[i], s.depth[i], s.slant[i]);
}

void fuse_block(const FuseJob& job, const float* first, uint32_t seed, Block& block) {
    Samples s;
    alignas(64) float share[kLayer], color_share[kLayer], distance[kLayer], weight[kLayer];
    alignas(64) uint32_t noise[kLayer];
    alignas(64) int32_t changed[kLayer];
    for (int layer = 0; layer < kSide; layer++) {
        if (!project(job, first, layer, s)) continue;
        bool some_before, close;
        gather(job, s, some_before, close);
        if (!some_before) continue;
        if (close) {
            gather_neighbours(job, s);
            interpolate(job, s);
        }
        for (int i = 0; i < kLayer; i++) s.shade[i] = job.shade[s.pixel[i]];
        int16_t* const d = block.distance + layer * kLayer;
        uint16_t* const w = block.weight + layer * kLayer;
        for (int i = 0; i < kLayer; i++) {
            const float before = (float)w[i];
            const float added = added_weight(job.band, s.inside[i], s.depth[i], s.z[i], s.slant[i], s.shade[i]);
            const Shares shared = shares(before, added);
            changed[i] = added > 0 ? 1 : 0;
            distance[i] = seen_distance(job.band, s.depth[i], s.z[i], s.slant[i]);
            share[i] = shared.distance;
            color_share[i] = shared.color;
            weight[i] = shared.weight;
            noise[i] = dither(seed, layer * kLayer + i, before);
        }
        int32_t some = 0;
        for (int i = 0; i < kLayer; i++) some |= changed[i];
        if (!some) continue;
        for (int i = 0; i < kLayer; i++) w[i] = changed[i] ? (uint16_t)(int32_t)weight[i] : w[i];
        for (int i = 0; i < kLayer; i++)
            d[i] = changed[i] ? (int16_t)mean_distance((float)d[i], distance[i], share[i], noise[i]) : d[i];
        for (int channel = 0; channel < 3; channel++) {
            uint8_t* const c = block.color[channel] + layer * kLayer;
            for (int i = 0; i < kLayer; i++) {
                const int whole = mean_color((float)c[i], s.shade[i], channel, color_share[i], noise[i]);
                c[i] = changed[i] ? (uint8_t)whole : c[i];
            }
        }
    }
}

constexpr int kPiece = 64;  // pixels

void reach_piece(const RowJob& job, int from, int count, uint64_t* low_key, uint64_t* high_key) {
    int32_t low[3][kPiece], high[3][kPiece], there[kPiece];
    const float* depth = job.depth + from;
    const uint32_t* shade = job.shade + from;
    double u[kPiece], v[kPiece], w[kPiece];
    for (int i = 0; i < count; i++) {
        const double d = depth[i];
        there[i] = (d > 0 ? 1 : 0) & (shade[i] >> 24 ? 1 : 0);
        w[i] = d * job.per_block;
        u[i] = ((double)(from + i) + 0.5 - job.cx) / job.fx * w[i];
        v[i] = job.row * w[i];
    }
    for (int axis = 0; axis < 3; axis++) {
        const double* r = job.turn[axis];
        for (int i = 0; i < count; i++) {
            const double at = r[0] * u[i] + r[1] * v[i] + r[2] * w[i] + job.eye[axis];
            const int32_t first = block_of(at - job.reach), last = block_of(at + job.reach);
            low[axis][i] = first > job.low[axis] ? first : job.low[axis];
            high[axis][i] = last < job.high[axis] ? last : job.high[axis];
            there[i] &= low[axis][i] <= high[axis][i] ? 1 : 0;
        }
    }
    for (int i = 0; i < count; i++) low_key[i] = there[i] ? packed(low[0][i], low[1][i], low[2][i]) : kNoKey;
    for (int i = 0; i < count; i++) high_key[i] = there[i] ? packed(high[0][i], high[1][i], high[2][i]) : kNoKey;
}

void reach_row(const RowJob& job, uint64_t* low, uint64_t* high) {
    for (int at = 0; at < job.width; at += kPiece)
        reach_piece(job, at, std::min(kPiece, job.width - at), low + at, high + at);
}

inline uint32_t byte_of(float x) {
    const float low = x > 0 ? x : 0.0f, clamped = low < 1 ? low : 1.0f;
    return (uint32_t)(int32_t)(clamped * 255.0f + 0.5f);
}

void shade_row(const ShadeJob& job, int row, uint32_t* shade, float* slant) {
    const int64_t plane = (int64_t)job.width * job.height, from = (int64_t)row * job.width;
    const float *d = job.depth + from, *r = job.color + from, *g = r + plane, *b = g + plane;
    const float ray_y = ((float)row + 0.5f - job.cy) / job.fy;
    const bool turned = job.normal != nullptr;
    const float *nx = turned ? job.normal + from : d, *ny = turned ? nx + plane : d, *nz = turned ? ny + plane : d;
    for (int i = 0; i < job.width; i++) {
        const float share = job.near / (d[i] > 1e-20f ? d[i] : 1e-20f), size = share < 1 ? share : 1.0f;
        const float ray_x = ((float)i + 0.5f - job.cx) / job.fx;
        const float along = -(nx[i] * ray_x + ny[i] * ray_y + nz[i]);
        const float normal = nx[i] * nx[i] + ny[i] * ny[i] + nz[i] * nz[i], unit = __builtin_sqrtf(normal);
        const float steep = along / (unit > 1e-10f ? unit : 1e-10f);
        slant[i] = turned ? (steep > job.least ? steep : job.least) : 1.0f;
        const float square = normal * (ray_x * ray_x + ray_y * ray_y + 1.0f);
        const float length = __builtin_sqrtf(square), cosine = along / (length > 1e-10f ? length : 1e-10f);
        const float upright = turned ? (cosine < 1 ? cosine : 1.0f) : 1.0f;
        const float weight = size * size * (upright > 0 ? upright : 0.0f);
        const int32_t whole = (int32_t)(weight * kFullWeight + 0.5f);
        const uint32_t counted = (uint32_t)(whole > 1 ? whole : 1);
        const uint32_t color = byte_of(r[i]) | byte_of(g[i]) << 8 | byte_of(b[i]) << 16;
        shade[i] = color | (((weight > 0) & (d[i] > 0)) ? counted << 24 : 0u);
    }
}

}  // namespace

const FuseKernels& SURFKIT_TABLE(SURFKIT_KERNELS)() {
    static const FuseKernels table{fuse_block, reach_row, shade_row};
    return table;
}

}  // namespace surfkit
