// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table. Plain loops over one layer of a
// block, which compilers turn into vectors; without contraction, so that all three give the same bits.
#include "fuse.h"

#include <algorithm>

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(fuse_kernels_, name)

namespace surfkit {
namespace {

constexpr int kLayer = kSide * kSide;
constexpr float kSteps = 32767.0f, kMostWeight = 65535.0f;
constexpr float kMostColorWeight = 2048.0f;  // 64 views: colours go on following later ones

struct Samples {
    alignas(64) float z[kLayer], at_x[kLayer], at_y[kLayer], depth[kLayer];
    alignas(64) float corner[4][kLayer];
    alignas(64) int32_t pixel[kLayer], left[kLayer], right[kLayer], above[kLayer], below[kLayer];
    alignas(64) uint32_t shade[kLayer];
    alignas(64) int32_t inside[kLayer];
};

inline int clamped(int x, int most) { return x < 0 ? 0 : x > most ? most : x; }

// Where each voxel of a layer falls in the picture.
inline bool project(const FuseJob& job, const float* first, int layer, Samples& s) {
    const float *ox = job.offsets[0] + layer * kLayer, *oy = job.offsets[1] + layer * kLayer,
                *oz = job.offsets[2] + layer * kLayer;
    const float wide = (float)job.width, high = (float)job.height;
    int some = 0;
    for (int i = 0; i < kLayer; i++) {
        const float z = first[2] + oz[i];
        const float turn = 1.0f / z;
        const float u = (first[0] + ox[i]) * turn * job.fx + job.cx;
        const float v = (first[1] + oy[i]) * turn * job.fy + job.cy;
        const int32_t in = (z > 0) & (u >= 0) & (u < wide) & (v >= 0) & (v < high);
        const float x = in ? u : 0.0f, y = in ? v : 0.0f;
        s.z[i] = z;
        s.inside[i] = in;
        s.pixel[i] = (int32_t)y * job.width + (int32_t)x;
        const int32_t left = (int32_t)(x + 0.5f) - 1, above = (int32_t)(y + 0.5f) - 1;
        s.at_x[i] = x - 0.5f - (float)left;
        s.at_y[i] = y - 0.5f - (float)above;
        s.left[i] = left < 0 ? 0 : left;
        s.right[i] = left + 1 < job.width ? left + 1 : job.width - 1;
        s.above[i] = (above < 0 ? 0 : above) * job.width;
        s.below[i] = (above + 1 < job.height ? above + 1 : job.height - 1) * job.width;
        some |= in;
    }
    return some != 0;
}

// The depth of the pixel that each voxel falls on. Neighbours are asked only where they can matter: interpolation
// changes a depth by no more than the jump, which moves nothing that lies further in front of or behind the band.
inline void gather(const FuseJob& job, Samples& s, bool& some, bool& close) {
    for (int i = 0; i < kLayer; i++) s.depth[i] = job.depth[s.pixel[i]];
    const float reach = job.truncation + job.jump;
    int32_t before = 0, near = 0;
    for (int i = 0; i < kLayer; i++) {
        const float sdf = s.depth[i] - s.z[i];
        const int32_t counts = s.inside[i] & (s.depth[i] > 0 ? 1 : 0) & (sdf > -reach ? 1 : 0);
        s.inside[i] = counts;
        before |= counts;
        near |= counts & (sdf < reach ? 1 : 0);
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

inline uint32_t scrambled(uint32_t x) {
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}

// The depth between four pixels; that of the nearest one where they do not lie on one surface.
inline void interpolate(const FuseJob& job, Samples& s) {
    for (int i = 0; i < kLayer; i++) {
        const float a = s.corner[0][i], b = s.corner[1][i], c = s.corner[2][i], d = s.corner[3][i];
        const float low_ab = a < b ? a : b, low_cd = c < d ? c : d, low = low_ab < low_cd ? low_ab : low_cd;
        const float top_ab = a > b ? a : b, top_cd = c > d ? c : d, top = top_ab > top_cd ? top_ab : top_cd;
        const float above = a + (b - a) * s.at_x[i], below = c + (d - c) * s.at_x[i];
        const float between = above + (below - above) * s.at_y[i];
        const int32_t smooth = (low > 0) & (top - low <= job.jump) & (s.depth[i] > 0);
        s.depth[i] = smooth ? between : s.depth[i];
    }
}

void fuse_block(const FuseJob& job, const float* first, uint32_t seed, Block& block) {
    Samples s;
    alignas(64) float share[kLayer], color_share[kLayer], distance[kLayer], weight[kLayer];
    alignas(64) uint32_t noise[kLayer];
    alignas(64) int32_t changed[kLayer];
    const float far = -job.truncation, per_truncation = 1.0f / job.truncation;
    const float per_fade = 1.0f / (job.truncation - job.fade);
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
            const float sdf = s.depth[i] - s.z[i];
            const float fall = (job.truncation + sdf) * per_fade;
            const float trust = sdf < -job.fade ? fall : 1.0f;
            const int32_t near = s.inside[i] & (s.depth[i] > 0) & (sdf > far);
            const float added = (float)(int32_t)((float)(int32_t)(s.shade[i] >> 24) * (near ? trust : 0.0f) + 0.5f);
            const float before = (float)w[i], sum = before + added;
            const float scaled = sdf * per_truncation;
            const float sure = sum > 0 ? sum : 1.0f;
            changed[i] = added > 0 ? 1 : 0;
            distance[i] = (scaled < 1.0f ? scaled : 1.0f) * kSteps;
            share[i] = added / sure;
            color_share[i] = added / (sure < kMostColorWeight ? sure : kMostColorWeight);
            noise[i] = scrambled(seed + (uint32_t)(layer * kLayer + i) * 0x9e3779b9u + (uint32_t)before * 0x85ebca6bu);
            weight[i] = sum < kMostWeight ? sum : kMostWeight;
        }
        int32_t some = 0;
        for (int i = 0; i < kLayer; i++) some |= changed[i];
        if (!some) continue;
        for (int i = 0; i < kLayer; i++) w[i] = changed[i] ? (uint16_t)(int32_t)weight[i] : w[i];
        for (int i = 0; i < kLayer; i++) {
            const float old = (float)d[i];
            const float mean = old + (distance[i] - old) * share[i];
            const float random = (float)(int32_t)(noise[i] >> 16) * (1.0f / 65536);
            const float shifted = mean + 32768.0f + random;
            d[i] = changed[i] ? (int16_t)(clamped((int32_t)shifted, 65535) - 32768) : d[i];
        }
        for (int channel = 0; channel < 3; channel++) {
            uint8_t* const c = block.color[channel] + layer * kLayer;
            for (int i = 0; i < kLayer; i++) {
                const float old = (float)c[i], seen = (float)(int32_t)(s.shade[i] >> (8 * channel) & 255u);
                const float random = (float)(int32_t)(noise[i] & 65535u) * (1.0f / 65536);
                const float mean = old + (seen - old) * color_share[i] + random;
                const int32_t whole = clamped((int32_t)mean, 255);
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
    const double most = kBlockBias - 1;
    for (int axis = 0; axis < 3; axis++) {
        const double* r = job.turn[axis];
        for (int i = 0; i < count; i++) {
            const double at = r[0] * u[i] + r[1] * v[i] + r[2] * w[i] + job.eye[axis];
            const double a = at - job.reach, b = at + job.reach;
            const double from_block = a < -most ? -most : a > most ? most : a;
            const double to_block = b < -most ? -most : b > most ? most : b;
            const int32_t first = (int32_t)(from_block + kBlockBias) - kBlockBias;  // rounded down
            const int32_t last = (int32_t)(to_block + kBlockBias) - kBlockBias;
            low[axis][i] = first > job.low[axis] ? first : job.low[axis];
            high[axis][i] = last < job.high[axis] ? last : job.high[axis];
            there[i] &= low[axis][i] <= high[axis][i] ? 1 : 0;
        }
    }
    for (int i = 0; i < count; i++) {
        const uint64_t z = (uint32_t)(low[2][i] + kBlockBias), y = (uint32_t)(low[1][i] + kBlockBias),
                       x = (uint32_t)(low[0][i] + kBlockBias);
        low_key[i] = there[i] ? z << 2 * kBlockBits | y << kBlockBits | x : kNoKey;
    }
    for (int i = 0; i < count; i++) {
        const uint64_t z = (uint32_t)(high[2][i] + kBlockBias), y = (uint32_t)(high[1][i] + kBlockBias),
                       x = (uint32_t)(high[0][i] + kBlockBias);
        high_key[i] = there[i] ? z << 2 * kBlockBits | y << kBlockBits | x : kNoKey;
    }
}

void reach_row(const RowJob& job, uint64_t* low, uint64_t* high) {
    for (int at = 0; at < job.width; at += kPiece)
        reach_piece(job, at, std::min(kPiece, job.width - at), low + at, high + at);
}

inline uint32_t byte_of(float x) {
    const float low = x > 0 ? x : 0.0f, clamped = low < 1 ? low : 1.0f;
    return (uint32_t)(int32_t)(clamped * 255.0f + 0.5f);
}

void shade_row(const ShadeJob& job, int row, uint32_t* shade) {
    const int64_t plane = (int64_t)job.width * job.height, from = (int64_t)row * job.width;
    const float *d = job.depth + from, *r = job.color + from, *g = r + plane, *b = g + plane;
    const float ray_y = ((float)row + 0.5f - job.cy) / job.fy;
    const bool turned = job.normal != nullptr;
    const float *nx = turned ? job.normal + from : d, *ny = turned ? nx + plane : d, *nz = turned ? ny + plane : d;
    for (int i = 0; i < job.width; i++) {
        const float share = job.near / (d[i] > 1e-20f ? d[i] : 1e-20f), size = share < 1 ? share : 1.0f;
        const float ray_x = ((float)i + 0.5f - job.cx) / job.fx;
        const float along = -(nx[i] * ray_x + ny[i] * ray_y + nz[i]);
        const float square = (nx[i] * nx[i] + ny[i] * ny[i] + nz[i] * nz[i]) * (ray_x * ray_x + ray_y * ray_y + 1.0f);
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
