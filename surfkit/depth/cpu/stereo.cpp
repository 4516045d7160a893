// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table.
//
// PatchMatch stereo (Bleyer et al. 2011) with the checkerboard of Galliani et al. 2015: pixels of one colour try the planes
// of pixels of the other colour, so all of one colour can be worked on at once and the order does not matter. The views that
// count are chosen for every pixel by what its neighbours match well (after Xu and Tao 2019).
#include "stereo.h"

#include <algorithm>

#include "../../raster/cpu/simd.h"

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(stereo_kernels_, name)

namespace surfkit {
namespace {

constexpr int kVectors = kSamples / kLanes;
constexpr float kNoise = 1.0f;       // variance of grey values below which a window shows nothing
constexpr float kNothing = 2.0f;     // cost of a plane that a view does not show; more than that of any match
constexpr float kOblique = 0.12f;    // least cosine between the normal of a plane and the ray
constexpr float kMostError = 3.0f;   // pixels of reprojection
constexpr float kMostBend = 2.0f;    // pixels of parallax between neighbours; more is an edge
constexpr float kSame = 0.06f;       // pixels of parallax by which planes differ that need not be tried

struct Window {
    Floats weight[kVectors], centred[kVectors];  // weights that sum to 1; times the grey values less their mean
    float contrast;
};

struct Plane {
    float w, gx, gy;
};

static inline Ints gather(const uint32_t* base, Ints at) {
#if defined(__AVX512F__)
    return (Ints)_mm512_i32gather_epi32((__m512i)at, base, 4);
#elif defined(__AVX2__)
    return (Ints)_mm256_i32gather_epi32((const int*)base, (__m256i)at, 4);
#else
    Ints r;
    for (int i = 0; i < kLanes; i++) r[i] = (int32_t)base[at[i]];
    return r;
#endif
}

static inline float total(Floats v) {
    alignas(64) float out[4];
    const Floats four[4] = {v, Floats{}, Floats{}, Floats{}};
    sum_lanes(four, 4, out);
    return out[0];
}

static inline Floats grey(Ints v, int shift) { return __builtin_convertvector((v >> shift) & 255, Floats); }

SURFKIT_INLINE void look(const StereoJob& job, int x, int y, Window& out) {
    const int stride = job.width + 2 * kRadius;
    const float* middle = job.image + (int64_t)(y + kRadius) * stride + x + kRadius;
    const float here = *middle, scale = -1.0f / job.spread;
    Floats value[kVectors], all = {}, mean = {};
    for (int v = 0; v < kVectors; v++) {
        const Ints at = __builtin_convertvector(
            load(job.offset_y + v * kLanes) * (float)stride + load(job.offset_x + v * kLanes), Ints);
        const Ints raw = gather((const uint32_t*)middle, at);
        std::memcpy(&value[v], &raw, sizeof raw);
        out.weight[v] = load(job.nearness + v * kLanes) * exp_negative(magnitude(value[v] - here) * scale);
        all += out.weight[v];
        mean = madd(out.weight[v], value[v], mean);
    }
    const float turn = 1.0f / total(all), m = total(mean) * turn;
    Floats square = {};
    for (int v = 0; v < kVectors; v++) {
        out.weight[v] = out.weight[v] * turn;
        const Floats d = value[v] - m;
        out.centred[v] = out.weight[v] * d;
        square = madd(out.centred[v], d, square);
    }
    out.contrast = total(square) + kNoise;
}

// 1 - correlation of a window with what a view shows on a plane through it; kNothing if the view does not show the middle.
SURFKIT_INLINE float compare(const StereoJob& job, const Window& window, const StereoSource& s, float x, float y, const Plane& p) {
    const float base[3] = {s.a[0] * x + s.a[1] * y + s.a[2] + s.b[0] * p.w,
                           s.a[3] * x + s.a[4] * y + s.a[5] + s.b[1] * p.w,
                           s.a[6] * x + s.a[7] * y + s.a[8] + s.b[2] * p.w};
    const float wide = (float)(s.width - 1), high = (float)(s.height - 1);
    if (!(base[2] > 0) || !(base[0] >= 0) || !(base[1] >= 0) || base[0] > wide * base[2] || base[1] > high * base[2])
        return kNothing;
    const Floats hx = broadcast(s.a[0] + s.b[0] * p.gx), hy = broadcast(s.a[1] + s.b[0] * p.gy);
    const Floats vx = broadcast(s.a[3] + s.b[1] * p.gx), vy = broadcast(s.a[4] + s.b[1] * p.gy);
    const Floats zx = broadcast(s.a[6] + s.b[2] * p.gx), zy = broadcast(s.a[7] + s.b[2] * p.gy);
    const Floats zero = {}, most_x = broadcast(wide), most_y = broadcast(high);
    Floats sum = {}, square = {}, both = {};
    for (int v = 0; v < kVectors; v++) {
        const Floats dx = load(job.offset_x + v * kLanes), dy = load(job.offset_y + v * kLanes);
        const Floats turn = reciprocal(madd(zx, dx, madd(zy, dy, broadcast(base[2]))));
        const Floats at_x = higher(zero, lower(most_x, madd(hx, dx, madd(hy, dy, broadcast(base[0]))) * turn));
        const Floats at_y = higher(zero, lower(most_y, madd(vx, dx, madd(vy, dy, broadcast(base[1]))) * turn));
        const Ints left = __builtin_convertvector(at_x, Ints), above = __builtin_convertvector(at_y, Ints);
        const Floats fx = at_x - __builtin_convertvector(left, Floats);
        const Floats fy = at_y - __builtin_convertvector(above, Floats);
        const Ints four = gather(s.pixels, above * s.width + left);
        const Floats a = grey(four, 0), b = grey(four, 8), c = grey(four, 16), d = grey(four, 24);
        const Floats upper = madd(fx, b - a, a), under = madd(fx, d - c, c);
        const Floats value = madd(fy, under - upper, upper);
        const Floats weighed = window.weight[v] * value;
        sum += weighed;
        square = madd(weighed, value, square);
        both = madd(window.centred[v], value, both);
    }
    const Floats sums[4] = {sum, square, both, Floats{}};
    alignas(64) float out[4];
    sum_lanes(sums, 4, out);
    const float variance = std::max(0.0f, out[1] - out[0] * out[0]) + kNoise;
    return std::min(1.0f, std::max(0.0f, 1.0f - out[2] / std::sqrt(variance * window.contrast)));
}

// Pixels by which a pixel misses itself when it is carried to a view and back by the depth found there (ACMM).
SURFKIT_INLINE float reprojection(const StereoSource& s, float x, float y, float w) {
    const float z = s.a[6] * x + s.a[7] * y + s.a[8] + s.b[2] * w;
    const float u = (s.a[0] * x + s.a[1] * y + s.a[2] + s.b[0] * w) / z;
    const float v = (s.a[3] * x + s.a[4] * y + s.a[5] + s.b[1] * w) / z;
    const float at_x = (u + 0.5f) * s.to_inverse[0], at_y = (v + 0.5f) * s.to_inverse[1];
    if (!(z > 0) || !(at_x >= 0) || !(at_y >= 0) || !(at_x < (float)s.inverse_width) || !(at_y < (float)s.inverse_height))
        return kMostError;
    const float found = s.inverse[(int64_t)(int)at_y * s.inverse_width + (int)at_x];
    if (!(found > 0)) return kMostError;
    const float back = s.back_a[6] * u + s.back_a[7] * v + s.back_a[8] + s.back_b[2] * found;
    const float to_x = (s.back_a[0] * u + s.back_a[1] * v + s.back_a[2] + s.back_b[0] * found) / back;
    const float to_y = (s.back_a[3] * u + s.back_a[4] * v + s.back_a[5] + s.back_b[1] * found) / back;
    const float miss = std::sqrt((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y));
    return back > 0 && miss < kMostError ? miss : kMostError;
}

// Draws that depend on pixel and pass alone, so that no order of the work changes them.
struct Draw {
    uint32_t state;
    float operator()() {  // in [-1, 1)
        state = state * 747796405u + 2891336453u;
        uint32_t word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737u;
        word = (word >> 22) ^ word;
        return (float)(int32_t)word * (1.0f / 2147483648.0f);
    }
};

struct Pixel {
    const StereoJob& job;
    const int x, y;
    Window window;
    int chosen[kMostViews];
    int count = 0;         // of the chosen
    float around[4];       // inverse depths of the four neighbours
    float offset[4][2];
    float alike[4];        // how far their grey values are those of this pixel
    int neighbours = 0;
    Plane plane;
    float cost;

    Plane at(int px, int py) const {
        const float* p = job.plane + ((int64_t)py * job.width + px) * 3;
        return {p[0], p[1], p[2]};
    }

    // The plane of another pixel, as it goes on to this one.
    Plane carried(int px, int py) const {
        Plane p = at(px, py);
        p.w += p.gx * (float)(x - px) + p.gy * (float)(y - py);
        return p;
    }

    bool valid(const Plane& p) const {
        if (!(p.w >= job.low) || !(p.w <= job.high)) return false;
        const float rx = ((float)x + 0.5f - job.cx) / job.fx, ry = ((float)y + 0.5f - job.cy) / job.fy;
        const float nx = p.gx * job.fx, ny = p.gy * job.fy, nz = p.w - nx * rx - ny * ry;
        const float lengths = (nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0f);
        return p.w * p.w > kOblique * kOblique * lengths;
    }

    // How much a plane differs from what lies around: less where the picture changes, and no more than at an edge.
    float roughness(const Plane& p) const {
        float sum = 0;
        for (int i = 0; i < neighbours; i++) {
            const float there = p.w + p.gx * offset[i][0] + p.gy * offset[i][1];
            sum += alike[i] * std::min(kMostBend, std::fabs(there - around[i]) * job.parallax);
        }
        return job.smoothness * sum / 4;
    }

    float seen(int view, const Plane& p) const {
        const StereoSource& s = job.sources[view];
        const float match = compare(job, window, s, (float)x, (float)y, p);
        if (!s.inverse || match >= kNothing) return match;
        return match + job.consistency * reprojection(s, (float)x, (float)y, p.w);
    }

    void gather_around() {
        const int stride = job.width + 2 * kRadius;
        const float* middle = job.image + (int64_t)(y + kRadius) * stride + x + kRadius;
        static const int steps[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
        for (const auto& step : steps) {
            const int px = x + step[0], py = y + step[1];
            if (px < 0 || py < 0 || px >= job.width || py >= job.height) continue;
            around[neighbours] = at(px, py).w;
            alike[neighbours] = std::exp(-std::fabs(middle[step[1] * stride + step[0]] - *middle) / job.spread);
            offset[neighbours][0] = (float)step[0];
            offset[neighbours++][1] = (float)step[1];
        }
    }

    // Costs of the present plane in all views, and the views that count: those that match best here and around.
    void choose() {
        const int64_t here = ((int64_t)y * job.width + x) * job.views;
        float cost_of[kMostViews];
        int vote[kMostViews];
        for (int view = 0; view < job.views; view++) {
            if (job.survey) {
                cost_of[view] = seen(view, plane);
                job.each[here + view] = (uint8_t)(std::min(cost_of[view], 1.0f) * 255.0f);
            }
            vote[view] = 2 * job.each[here + view];
            for (int i = 0; i < neighbours; i++) {
                const int64_t there = (int64_t)(y + (int)offset[i][1]) * job.width + x + (int)offset[i][0];
                vote[view] += job.each[there * job.views + view];
            }
            vote[view] = vote[view] * kMostViews + view;  // equal ones in their order
        }
        std::sort(vote, vote + job.views);
        count = std::min(job.best, job.views);
        cost = roughness(plane);
        for (int i = 0; i < count; i++) {
            const int view = chosen[i] = vote[i] % kMostViews;
            if (!job.survey) {
                cost_of[view] = seen(view, plane);
                job.each[here + view] = (uint8_t)(std::min(cost_of[view], 1.0f) * 255.0f);
            }
            cost += cost_of[view] / (float)count;
        }
    }

    void attempt(const Plane& p) {
        if (!valid(p)) return;
        const float by = std::fabs(p.w - plane.w) + 2.0f * (std::fabs(p.gx - plane.gx) + std::fabs(p.gy - plane.gy));
        if (by * job.parallax < kSame) return;
        float sum = roughness(p);
        for (int i = 0; i < count && sum < cost; i++) sum += seen(chosen[i], p) / (float)count;
        if (sum < cost) {
            cost = sum;
            plane = p;
        }
    }

    // Planes of the neighbours, and of the best of those further away in each direction.
    void propagate() {
        static const int steps[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
        for (const auto& step : steps) {
            int best_x = -1, best_y = -1;
            float least = 1e9f;
            for (int far = 1; far <= 11; far += 2) {
                const int px = x + far * step[0], py = y + far * step[1];
                if (px < 0 || py < 0 || px >= job.width || py >= job.height) break;
                if (far == 1) {
                    attempt(carried(px, py));
                } else if (const float c = job.cost[(int64_t)py * job.width + px]; c < least) {
                    least = c, best_x = px, best_y = py;
                }
            }
            if (best_x >= 0) attempt(carried(best_x, best_y));
        }
    }

    // The slopes that the neighbours make, and small changes at random.
    void refine(Draw draw) {
        if (neighbours == 4) {
            attempt({plane.w, (around[1] - around[0]) / 2, (around[3] - around[2]) / 2});
            attempt({(around[0] + around[1] + around[2] + around[3]) / 4, plane.gx, plane.gy});
        }
        float by = job.jitter_px / job.parallax;
        for (int i = 0; i < 2; i++, by /= 4) {
            const float w = by * draw(), gx = by * draw() / kRadius, gy = by * draw() / kRadius;
            attempt({plane.w + w, plane.gx, plane.gy});
            attempt({plane.w, plane.gx + gx, plane.gy + gy});
        }
    }
};

void improve(const StereoJob& job, int row, int colour) {
    for (int x = (row + colour) & 1; x < job.width; x += 2) {
        const int64_t here = (int64_t)row * job.width + x;
        Pixel pixel{job, x, row};
        look(job, x, row, pixel.window);
        pixel.plane = pixel.at(x, row);
        pixel.gather_around();
        pixel.choose();
        pixel.propagate();
        pixel.refine({job.seed ^ (uint32_t)here * 2654435761u});
        float* out = job.plane + here * 3;
        out[0] = pixel.plane.w, out[1] = pixel.plane.gx, out[2] = pixel.plane.gy;
        job.cost[here] = pixel.cost;
    }
}

}  // namespace

const StereoKernels& SURFKIT_TABLE(SURFKIT_KERNELS)() {
    static const StereoKernels table{improve};
    return table;
}

}  // namespace surfkit
