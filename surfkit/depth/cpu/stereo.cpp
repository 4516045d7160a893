// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table, and once more for AVX-512 with
// SURFKIT_GATHER, for processors that gather quickly.
//
// PatchMatch stereo (Bleyer et al. 2011) with the checkerboard of Galliani et al. 2015: pixels of one colour try the planes
// of pixels of the other colour, so all of one colour can be worked on at once and the order does not matter. The views that
// count are chosen for every pixel by what its neighbours match well (after Xu and Tao 2019).
#include "stereo.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "../../raster/native/simd.h"

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(stereo_kernels_, name)

namespace surfkit {
namespace {

constexpr int kVectors = kSamples / kLanes;  // at most
constexpr int kTrials = 16;  // room for planes that are tried together

// A number for each view.
typedef int16_t Votes __attribute__((vector_size(2 * kMostViews)));
static_assert(kMostViews == 16, "each view has its place in the order");
constexpr Votes kOrder = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

struct Window {
    Floats weight[kVectors], centred[kVectors];  // weights that sum to 1; times the grey values less their mean
    float contrast, mean;
};

struct Plane {
    float w, gx, gy;
};

// What is at `base`, and `step` bytes further for each that `at` counts. Without SURFKIT_GATHER one load after the other,
// put together by insertion: on an AMD EPYC that takes less time than the instruction that gathers.
#if defined(SURFKIT_GATHER)
template <int step>
SURFKIT_INLINE Ints gather(const void* base, Ints at) {
    return (Ints)_mm512_i32gather_epi32((__m512i)at, base, step);
}
#else
template <int step>
SURFKIT_INLINE Ints gather(const void* base, Ints at) {
    const auto word = [base](int64_t i) {
        int32_t found;
        std::memcpy(&found, (const char*)base + i * step, sizeof found);
        return found;
    };
#if defined(__AVX2__) || defined(__AVX512F__)
    const auto four = [&](__m128i i) {
        const int64_t a = _mm_cvtsi128_si64(i), b = _mm_extract_epi64(i, 1);
        __m128i r = _mm_cvtsi32_si128(word((int32_t)a));
        r = _mm_insert_epi32(r, word(a >> 32), 1);
        r = _mm_insert_epi32(r, word((int32_t)b), 2);
        return _mm_insert_epi32(r, word(b >> 32), 3);
    };
    const auto eight = [&](__m256i i) {
        return _mm256_inserti128_si256(_mm256_castsi128_si256(four(_mm256_castsi256_si128(i))),
                                       four(_mm256_extracti128_si256(i, 1)), 1);
    };
#endif
#if defined(__AVX512F__)
    const __m512i all = (__m512i)at;
    return (Ints)_mm512_inserti64x4(_mm512_castsi256_si512(eight(_mm512_castsi512_si256(all))),
                                    eight(_mm512_extracti64x4_epi64(all, 1)), 1);
#elif defined(__AVX2__)
    return (Ints)eight((__m256i)at);
#else
    Ints r;
    for (int i = 0; i < kLanes; i++) r[i] = word(at[i]);
    return r;
#endif
}
#endif

// Of the first `count` lanes, those that are set, as bits.
static inline uint32_t first(Mask m, int count) { return bits(m) & (count < kLanes ? (1u << count) - 1 : ~0u); }

static inline float total(Floats v) {
    alignas(64) float out[4];
    const Floats four[4] = {v, Floats{}, Floats{}, Floats{}};
    sum_lanes(four, 4, out);
    return out[0];
}

SURFKIT_INLINE void look(const StereoJob& job, int x, int y, Window& out) {
    const int stride = job.width + 2 * kRadius;
    const float* middle = job.image + (int64_t)(y + kRadius) * stride + x + kRadius;
    const float here = *middle, scale = -1.0f / job.spread;
    Floats value[kVectors], all = {}, mean = {};
    for (int v = 0; v < job.samples / kLanes; v++) {
        const Ints at = __builtin_convertvector(
            load(job.offset_y + v * kLanes) * (float)stride + load(job.offset_x + v * kLanes), Ints);
        const Ints raw = gather<4>(middle, at);
        std::memcpy(&value[v], &raw, sizeof raw);
        out.weight[v] = load(job.nearness + v * kLanes) * exp_negative(magnitude(value[v] - here) * scale);
        all += out.weight[v];
        mean = madd(out.weight[v], value[v], mean);
    }
    const float turn = 1.0f / (total(all) + kTiny), m = total(mean) * turn;
    Floats square = {};
    for (int v = 0; v < job.samples / kLanes; v++) {
        out.weight[v] = out.weight[v] * turn;
        const Floats d = value[v] - m;
        out.centred[v] = out.weight[v] * d;
        square = madd(out.centred[v], d, square);
    }
    out.contrast = total(square) + kNoise;
    out.mean = m;
}

// Grey values between pixels, times 64 * 64, at fixed-point positions of which six bits are fractions. Two pixels of a
// column are next to each other, so four bytes from there are those that interpolation takes.
SURFKIT_INLINE Ints between(const StereoSource& s, Ints x, Ints y) {
    const Ints four = gather<2>(s.pixels, (y >> kFraction) * s.stride + (x >> kFraction));
    const Ints right = x & (kOne - 1), down = y & (kOne - 1);
#if defined(__AVX512BW__)
    const __m512i along = _mm512_maddubs_epi16((__m512i)four, (__m512i)(0x00ff00ff * down + 0x00400040));
    return (Ints)_mm512_madd_epi16(along, (__m512i)(0xffff * right + kOne));
#elif defined(__AVX2__) && !defined(__AVX512F__)
    const __m256i along = _mm256_maddubs_epi16((__m256i)four, (__m256i)(0x00ff00ff * down + 0x00400040));
    return (Ints)_mm256_madd_epi16(along, (__m256i)(0xffff * right + kOne));
#else
    const Ints here = (four & 255) * (kOne - down) + (four >> 8 & 255) * down;
    const Ints next = (four >> 16 & 255) * (kOne - down) + (four >> 24 & 255) * down;
    return here * (kOne - right) + next * right;
#endif
}

// Planes through one pixel that are tried together, so that none waits for another.
struct Trials {
    alignas(64) float w[kTrials], gx[kTrials], gy[kTrials];
    alignas(64) float cost[kTrials];  // of all views so far
    int count = 0;

    void add(const Plane& p) { w[count] = p.w, gx[count] = p.gx, gy[count] = p.gy, count++; }
    Plane at(int i) const { return {w[i], gx[i], gy[i]}; }
    void move(int from, int to) { w[to] = w[from], gx[to] = gx[from], gy[to] = gy[from], cost[to] = cost[from]; }

    void fill() {  // lanes that are not used
        for (int i = count; i % kLanes; i++) w[i] = gx[i] = gy[i] = 0;
    }
};

// Windows on planes as some views see them, one view after the other without gaps, so that few lanes are idle and the work
// on one view does not wait for that on another. Room for what vectors write beyond the last one.
struct Sights {
    static constexpr int kRoom = kMostViews * kTrials + kLanes;
    float u[kRoom], v[kRoom], ux[kRoom], uy[kRoom], vx[kRoom], vy[kRoom];  // fixed-point
    float match[kRoom], gain[kRoom];
};

// Where the middle of the window falls in view number `n` of those that are looked at, and what a step in the window moves it
// by: across a window, the map to a view is taken as affine. `match` is 0, or kNothing where the view does not show the
// middle, or shows it many times larger.
SURFKIT_INLINE void project(const StereoJob& job, const StereoSource& s, float x, float y, const Trials& trials, Sights& out,
                            int n) {
    const float* t = s.way;
    const float from[3] = {t[0] * x + t[1] * y + t[2], t[3] * x + t[4] * y + t[5], t[6] * x + t[7] * y + t[8]};
    const float wide = (float)(s.width - 1), high = (float)(s.height - 1);
    const Floats zero{};
    for (int i = 0; i < trials.count; i += kLanes) {
        const int to = n * trials.count + i;
        const Floats w = load(trials.w + i), gx = load(trials.gx + i), gy = load(trials.gy + i);
        const Floats z = madd(w, t[11], from[2]), turn = reciprocal(higher(z, broadcast(1e-20f)));
        const Floats u = madd(w, t[9], from[0]) * turn, v = madd(w, t[10], from[1]) * turn;
        const Floats zx = madd(gx, t[11], t[6]), zy = madd(gy, t[11], t[7]);
        const Floats ux = (madd(gx, t[9], t[0]) - u * zx) * turn, uy = (madd(gy, t[9], t[1]) - u * zy) * turn;
        const Floats vx = (madd(gx, t[10], t[3]) - v * zx) * turn, vy = (madd(gy, t[10], t[4]) - v * zy) * turn;
        const Mask shown = lesser(zero, z) & less_equal(zero, u) & less_equal(zero, v) & less_equal(u, wide) &
                           less_equal(v, high) & less_equal(magnitude(ux) + magnitude(uy), job.stretch) &
                           less_equal(magnitude(vx) + magnitude(vy), job.stretch);
        const float one = (float)kOne, border = (float)kBorder * one + 0.5f;
        store(out.u + to, madd(keep(shown, u), one, border)), store(out.v + to, madd(keep(shown, v), one, border));
        store(out.ux + to, keep(shown, ux) * one), store(out.uy + to, keep(shown, uy) * one);
        store(out.vx + to, keep(shown, vx) * one), store(out.vy + to, keep(shown, vy) * one);
        store(out.match + to, select(shown, zero, kNothing)), store(out.gain + to, broadcast(s.gain));
    }
}

// What the correlation of a window with one sight of it is made of.
struct Sums {
    Floats value[kLanes], square[kLanes], both[kLanes];
};

// Those of sight `at`, put at `to`.
SURFKIT_INLINE void add_up(const StereoJob& job, const StereoSource& s, const Window& window, const Sights& seen, int at,
                           Sums& sums, int to) {
    const Floats u = broadcast(seen.u[at]), ux = broadcast(seen.ux[at]), uy = broadcast(seen.uy[at]);
    const Floats v = broadcast(seen.v[at]), vx = broadcast(seen.vx[at]), vy = broadcast(seen.vy[at]);
    Floats sum = {}, square = {}, both = {};
    for (int j = 0; j < job.samples / kLanes; j++) {
        const Floats dx = load(job.offset_x + j * kLanes), dy = load(job.offset_y + j * kLanes);
        const Ints at_x = __builtin_convertvector(madd(ux, dx, madd(uy, dy, u)), Ints);
        const Ints at_y = __builtin_convertvector(madd(vx, dx, madd(vy, dy, v)), Ints);
        const Floats value = __builtin_convertvector(between(s, at_x, at_y), Floats);
        const Floats weighed = window.weight[j] * value;
        sum += weighed;
        square = madd(weighed, value, square);
        both = madd(window.centred[j], value, both);
    }
    sums.value[to] = sum, sums.square[to] = square, sums.both[to] = both;
}

// 1 - correlation of `count` sights, kLanes at most, plus the cost of their difference in brightness: by correlation alone,
// all faint windows look alike. kNothing stays.
SURFKIT_INLINE void correlate(const StereoJob& job, const Window& window, Sums& sums, int count, const float* gain,
                              float* match) {
    for (int i = count; i % 4; i++) sums.value[i] = sums.square[i] = sums.both[i] = Floats{};
    constexpr float kUnit = 1.0f / (kOne * kOne);
    const Floats mean = sum_each(sums.value, count) * kUnit, square = sum_each(sums.square, count) * (kUnit * kUnit);
    const Floats both = sum_each(sums.both, count) * kUnit, zero{};
    const Floats contrast = higher(zero, square - mean * mean) + kNoise;
    const Floats off = 1.0f - both / root(contrast * window.contrast);
    const Floats bright = mean * load(gain), both_bright = (bright + window.mean) * 0.5f + kDark;
    const Floats unlike = magnitude(bright - window.mean) / both_bright * job.brightness;
    const Floats all = higher(zero, off) + lower(broadcast(kUnlike), unlike);
    store(match, higher(load(match), lower(broadcast(1.0f), all)));
}

// `match` of all planes in these views, to which they have been projected.
SURFKIT_INLINE void compare(const StereoJob& job, const Window& window, const int* views, int number, int planes,
                            Sights& seen) {
    Sums sums;
    int at = 0, done = 0;
    for (int n = 0; n < number; n++) {
        for (int i = 0; i < planes; i++, at++) {
            add_up(job, job.sources[views[n]], window, seen, at, sums, at - done);
            if (at + 1 - done < kLanes) continue;
            correlate(job, window, sums, kLanes, seen.gain + done, seen.match + done);
            done = at + 1;
        }
    }
    if (done < at) correlate(job, window, sums, at - done, seen.gain + done, seen.match + done);
}

// `match`, and what the pixel misses itself by when it is carried to a view on each plane, and back by the depth found there
// (ACMM).
SURFKIT_INLINE Floats with_reprojection(const StereoJob& job, const StereoSource& s, float x, float y, Floats u, Floats v,
                                        Floats match) {
    const float* t = s.back;
    const Floats zero{}, wide = broadcast((float)s.inverse_width), high = broadcast((float)s.inverse_height);
    u = u * (1.0f / kOne) - (kBorder + 0.5f / kOne), v = v * (1.0f / kOne) - (kBorder + 0.5f / kOne);
    const Floats at_x = (u + 0.5f) * s.to_inverse[0], at_y = (v + 0.5f) * s.to_inverse[1];
    const Mask inside = less_equal(zero, at_x) & lesser(at_x, wide) & less_equal(zero, at_y) & lesser(at_y, high);
    const Ints column = __builtin_convertvector(keep(inside, at_x), Ints);
    const Ints row = __builtin_convertvector(keep(inside, at_y), Ints);
    const Ints word = gather<4>(s.inverse, row * s.inverse_width + column);
    Floats found;
    std::memcpy(&found, &word, sizeof found);
    const Floats z = madd(u, t[6], madd(v, t[7], madd(found, t[11], broadcast(t[8]))));
    const Floats turn = reciprocal(higher(z, broadcast(1e-20f)));
    const Floats off_x = madd(u, t[0], madd(v, t[1], madd(found, t[9], broadcast(t[2])))) * turn - x;
    const Floats off_y = madd(u, t[3], madd(v, t[4], madd(found, t[10], broadcast(t[5])))) * turn - y;
    const Mask known = inside & lesser(zero, found) & lesser(zero, z);
    const Floats miss = select(known, lower(broadcast(kMostError), root(madd(off_x, off_x, off_y * off_y))), kMostError);
    return select(lesser(match, kNothing), madd(miss, job.consistency, match), match);
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

// One pixel and pass. Which plane costs less is as good as random, so no branch depends on it where planes are ranked.
struct Pixel {
    const StereoJob& job;
    const int x, y;
    Window window;
    int chosen[kMostViews];  // views that are looked at
    int count = 0;
    float around[4];       // inverse depths of the four neighbours
    float offset[4][2];
    float alike[4];        // how far their grey values are those of this pixel
    int neighbours = 0;
    Plane plane;
    float cost;
    Trials trials;

    Pixel(const StereoJob& of, int right, int down) : job(of), x(right), y(down) {}  // the rest is not set

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

    void gather_around() {
        const int stride = job.width + 2 * kRadius;
        const float* middle = job.image + (int64_t)(y + kRadius) * stride + x + kRadius;
        static const int steps[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};
        for (const auto& step : steps) {
            const int px = x + step[0], py = y + step[1];
            if (px < 0 || py < 0 || px >= job.width || py >= job.height) continue;
            around[neighbours] = at(px, py).w;
            alike[neighbours] = job.alike[(int)std::fabs(middle[step[1] * stride + step[0]] - *middle)];
            offset[neighbours][0] = (float)step[0];
            offset[neighbours++][1] = (float)step[1];
        }
    }

    // What the views cost at a pixel.
    SURFKIT_INLINE Votes votes_at(const uint8_t* each) const {
        typedef uint8_t Bytes __attribute__((vector_size(kMostViews)));
        Bytes all{};
        if (job.views == kMostViews)  // a copy of known length is one load
            std::memcpy(&all, each, kMostViews);
        else
            std::memcpy(&all, each, job.views);
        return __builtin_convertvector(all, Votes);
    }

    // The views to look at: those that match best here and around.
    void choose() {
        uint8_t* here = job.each + ((int64_t)y * job.width + x) * job.views;
        if (job.survey) {
            trials.add(plane);
            trials.fill();
            int all[kMostViews];
            std::iota(all, all + job.views, 0);
            alignas(64) float match[kMostViews][kTrials];
            see(all, job.views, match);
            for (int view = 0; view < job.views; view++) here[view] = told(match[view][0]);
            trials.count = 0;
        }
        static_assert((2 + 4) * 255 * kMostViews + kMostViews <= INT16_MAX, "votes are 16 bits wide");
        Votes vote = 2 * votes_at(here), before{};  // the lowest match best; how many match better
        for (int i = 0; i < neighbours; i++)
            vote += votes_at(here + ((int)offset[i][1] * (int64_t)job.width + (int)offset[i][0]) * job.views);
        vote = vote * kMostViews + kOrder;  // equal ones in their order
        for (int view = 0; view < job.views; view++) before -= (Votes)(Votes{} + vote[view] < vote);
        count = std::min(kLooked * job.best, job.views);
        for (int view = 0; view < job.views; view++) chosen[before[view]] = view;
        const int nothing = (2 + neighbours) * 255;  // views that show neither this pixel nor those around it say nothing
        while (count > 1 && vote[chosen[count - 1]] / kMostViews >= nothing) count--;
    }

    // Keep the planes that cost least in the views looked at so far.
    void drop_worst(float (*match)[kTrials], int seen) {
        if (trials.count <= kKept) return;
        alignas(64) float so_far[kTrials];
        const float share = 1.0f / (float)seen;
        for (int i = 0; i < trials.count; i += kLanes) {
            Floats sum{};
            for (int at = 0; at < seen; at++) sum += lower(load(match[at] + i), broadcast(1.0f));
            store(so_far + i, madd(sum, share, load(trials.cost + i)));
        }
        int left = 0;
        for (int i = 0; i < trials.count && left < kKept; i++) {
            int better = 0;
            for (int j = 0; j < trials.count; j += kLanes)
                better += __builtin_popcount(first(lesser(load(so_far + j), so_far[i]), trials.count - j));
            trials.move(i, left);
            for (int at = 0; at < seen; at++) match[at][left] = match[at][i];
            left += better < kKept;
        }
        trials.count = left;
        trials.fill();
    }

    // Add the soft minimum of the least matches of each plane, of as many views as count: near their mean where all of them
    // match, while a view that matches badly, as something hides the place from it, adds little. Views that show nothing
    // count only where all others do too.
    void add_least(const float (*match)[kTrials]) {
        const int most = std::min(job.best, count);
        for (int i = 0; i < trials.count; i += kLanes) {
            Floats sorted[kMostViews];
            for (int k = 0; k < most; k++) sorted[k] = broadcast(kNever);
            for (int at = 0; at < count; at++) {
                Floats more = load(match[at] + i);
                for (int k = 0; k < most; k++) {
                    const Floats less = lower(sorted[k], more);
                    more = higher(sorted[k], more), sorted[k] = less;
                }
            }
            Floats sum = broadcast(1.0f), used = broadcast(1.0f);
            for (int k = 1; k < most; k++) {
                const Mask shown = lesser(sorted[k], kNothing);
                sum += keep(shown, exp_negative((sorted[0] - sorted[k]) * (1.0f / kHidden)));
                used += keep(shown, broadcast(1.0f));
            }
            store(trials.cost + i, load(trials.cost + i) + sorted[0] - log_positive(sum / used) * kHidden);
        }
    }

    static uint8_t told(float match) { return (uint8_t)(std::min(match, 1.0f) * 255.0f); }

    // What views say of all trials.
    void see(const int* views, int number, float (*match)[kTrials]) {
        Sights seen;
        for (int n = 0; n < number; n++) project(job, job.sources[views[n]], (float)x, (float)y, trials, seen, n);
        compare(job, window, views, number, trials.count, seen);
        for (int n = 0; n < number; n++) {
            const StereoSource& s = job.sources[views[n]];
            for (int i = 0; i < trials.count; i += kLanes) {
                const int at = n * trials.count + i;
                Floats found = load(seen.match + at);
                if (s.inverse)
                    found = with_reprojection(job, s, (float)x, (float)y, load(seen.u + at), load(seen.v + at), found);
                store(match[n] + i, found);
            }
        }
    }

    // Costs of the trials before any view is looked at: how much they differ from what lies around, less where the picture
    // changes and no more than at an edge; more where the window is so faint that noise decides how it matches. Planes are
    // dropped that are out of range, oblique, or like one before them; and the first, which is the present one, if its cost
    // is known.
    void screen(bool known) {
        trials.fill();
        const float rx = ((float)x + 0.5f - job.cx) / job.fx, ry = ((float)y + 0.5f - job.cy) / job.fy;
        const float smoothness = job.smoothness / 4 * (1.0f + kFaint / window.contrast);
        const float away = kOblique * kOblique * (rx * rx + ry * ry + 1.0f), same = kSame / job.parallax;
        for (int i = 0; i < trials.count; i += kLanes) {
            const Floats w = load(trials.w + i), gx = load(trials.gx + i), gy = load(trials.gy + i);
            const Floats nx = gx * job.fx, ny = gy * job.fy, nz = w - nx * rx - ny * ry;
            Floats rough{};
            for (int j = 0; j < neighbours; j++) {
                const Floats there = madd(gx, offset[j][0], madd(gy, offset[j][1], w));
                rough = madd(lower(broadcast(kMostBend), magnitude(there - around[j]) * job.parallax), alike[j], rough);
            }
            const Mask fits = less_equal(job.low, w) & less_equal(w, job.high) &
                              lesser((nx * nx + ny * ny + nz * nz) * away, w * w);
            store(trials.cost + i, select(fits, rough * smoothness, kNever));
        }
        for (int i = 1; i < trials.count; i++) {
            const float w = trials.w[i], gx = trials.gx[i], gy = trials.gy[i];
            for (int j = 0; j < i; j += kLanes) {
                const Floats by = magnitude(load(trials.gx + j) - gx) + magnitude(load(trials.gy + j) - gy);
                const Mask near = lesser(madd(by, kAcross, magnitude(load(trials.w + j) - w)), same);
                trials.cost[i] = first(near, i - j) ? kNever : trials.cost[i];
            }
        }
        int left = known ? 0 : 1;
        for (int i = 1; i < trials.count; i++) {
            trials.move(i, left);
            left += trials.cost[i] < kNever;
        }
        trials.count = left;
        trials.fill();
    }

    // Take the best of the trials, of which the first is the present plane; its cost may be known already. Each counts in the
    // views that match it best: a plane that lies far behind another is seen by other views.
    void attempt(bool known) {
        screen(known);
        alignas(64) float match[kMostViews][kTrials];
        const int few = std::min(job.best, count);
        see(chosen, few, match);
        if (few < count) {
            drop_worst(match, few);
            see(chosen + few, count - few, match + few);
        }
        add_least(match);
        int best = -1;
        float least = known ? cost : kNever;
        for (int i = 0; i < trials.count; i++) {
            best = trials.cost[i] < least ? i : best;
            least = std::min(least, trials.cost[i]);
        }
        if (best >= 0) {
            uint8_t* here = job.each + ((int64_t)y * job.width + x) * job.views;
            for (int at = 0; at < count; at++) here[chosen[at]] = told(match[at][best]);
            plane = trials.at(best);
        }
        cost = least;
        trials.count = 0;
    }

    // Planes of the neighbours, and of the best of those further away in each direction.
    void propagate() {
        const int steps[4][3] = {{-1, 0, x}, {1, 0, job.width - 1 - x}, {0, -1, y}, {0, 1, job.height - 1 - y}};
        const float* costs = job.cost + (int64_t)y * job.width + x;
        trials.add(plane);
        for (const auto& [right, down, room] : steps) {
            if (room < 1) continue;
            trials.add(carried(x + right, y + down));
            int best = 0;
            float least = kNever;
            for (int far = 3; far <= std::min(kFarthest, room); far += 2) {
                const float there = costs[far * (down * (int64_t)job.width + right)];
                best = there < least ? far : best;
                least = std::min(least, there);
            }
            if (best) trials.add(carried(x + best * right, y + best * down));
        }
        attempt(false);
    }

    // The slopes that the neighbours make, and a small change at random.
    void refine(Draw draw) {
        trials.add(plane);
        if (neighbours == 4) {
            trials.add({plane.w, (around[1] - around[0]) / 2, (around[3] - around[2]) / 2});
            trials.add({(around[0] + around[1] + around[2] + around[3]) / 4, plane.gx, plane.gy});
        }
        const float by = job.jitter_px / job.parallax;
        const float w = by * draw(), gx = by * draw() / kRadius, gy = by * draw() / kRadius;
        trials.add({plane.w + w, plane.gx, plane.gy});
        trials.add({plane.w, plane.gx + gx, plane.gy + gy});
        attempt(true);
    }
};

void improve(const StereoJob& job, int row, int colour) {
    for (int x = (row + colour) & 1; x < job.width; x += 2) {
        const int64_t here = (int64_t)row * job.width + x;
        Pixel pixel(job, x, row);
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
