// Kernels on whole images and columns: structural similarity, normals against depth, Adam. Part of kernels.cpp, and
// like it compiled once per instruction set.
#pragma once

#include <vector>

#include "../native/buffer.h"
#include "../native/simd.h"
#include "kernels.h"

namespace surfkit {
namespace {

// The first n lanes, n > 0.
inline Floats load_part(const float* p, int n) {
    if (n >= kLanes) return load(p);
    Floats v{};
    std::memcpy(&v, p, n * sizeof(float));
    return v;
}
inline void store_part(float* p, Floats v, int n) {
    if (n >= kLanes) return store(p, v);
    std::memcpy(p, &v, n * sizeof(float));
}

// ---- SSIM

constexpr int kRadius = 5;  // of the 11 x 11 window

struct Window {
    float w[kRadius + 1];
    Window() {
        double sum = 0, v[kRadius + 1];
        for (int i = 0; i <= kRadius; i++) {
            v[i] = std::exp(-i * i / (2 * 1.5 * 1.5));
            sum += i ? 2 * v[i] : v[i];
        }
        for (int i = 0; i <= kRadius; i++) w[i] = (float)(v[i] / sum);
    }
};
const Window& window() {
    static const Window table;
    return table;
}

// Rows with zeros around them, rounded up to whole vectors; row i replaces row i - count.
struct Rows {
    static constexpr int margin = 16;
    int stride, count;
    Buffer<float> data;  // one row more than `count`, which stays zero; 64-byte aligned, as the stride should be
    Rows(int width, int rows)
        : stride((width + 15) / 16 * 16 + 2 * margin), count(rows), data(buffer<float>((int64_t)stride * (rows + 1))) {
        std::memset(data.get(), 0, sizeof(float) * stride * (rows + 1));
    }
    float* row(int i) { return data.get() + (size_t)(i % count) * stride + margin; }
    const float* nothing() { return data.get() + (size_t)count * stride + margin; }
};
static_assert(kRadius <= Rows::margin, "the margin must hold the window");

inline Floats across(const float* p) {
    const float* w = window().w;
    Floats v = load(p) * w[0];
    for (int i = 1; i <= kRadius; i++) v = madd(load(p - i) + load(p + i), w[i], v);
    return v;
}
// The rows of the window about row y, nothing (zeros) beyond the image.
struct Column {
    const float* row[2 * kRadius + 1];
    Column(Rows& rows, int y, int height) {
        for (int i = -kRadius; i <= kRadius; i++)
            row[i + kRadius] = y + i >= 0 && y + i < height ? rows.row(y + i) : rows.nothing();
    }
    inline Floats blurred(int x) const {
        const float* w = window().w;
        Floats v = load(row[kRadius] + x) * w[0];
        for (int i = 1; i <= kRadius; i++) v = madd(load(row[kRadius - i] + x) + load(row[kRadius + i] + x), w[i], v);
        return v;
    }
};

double ssim_rows(const float* px, const float* py, int width, int height, int y0, int y1, float* d_mean,
                 float* d_square, float* d_cross) {
    const float c1 = 0.01f * 0.01f, c2 = 0.03f * 0.03f;
    const int ring = 2 * kRadius + 1;
    Rows x(width, 1), y(width, 1), square(width, 1), product(width, 1);
    Rows mx(width, ring), my(width, ring), ms(width, ring), mp(width, ring);
    double sum = 0;
    int next = y0 - kRadius < 0 ? 0 : y0 - kRadius;
    for (int row = y0; row < y1; row++) {
        for (; next <= row + kRadius && next < height; next++) {
            std::memcpy(x.row(0), px + (size_t)next * width, width * sizeof(float));
            std::memcpy(y.row(0), py + (size_t)next * width, width * sizeof(float));
            for (int i = 0; i < width; i += kLanes) {
                const Floats a = load(x.row(0) + i), b = load(y.row(0) + i);
                store(square.row(0) + i, madd(a, a, b * b));
                store(product.row(0) + i, a * b);
            }
            for (int i = 0; i < width; i += kLanes) {
                store(mx.row(next) + i, across(x.row(0) + i));
                store(my.row(next) + i, across(y.row(0) + i));
                store(ms.row(next) + i, across(square.row(0) + i));
                store(mp.row(next) + i, across(product.row(0) + i));
            }
        }
        Floats row_sum{};
        const Column cx(mx, row, height), cy(my, row, height), cs(ms, row, height), cp(mp, row, height);
        for (int i = 0; i < width; i += kLanes) {
            const Floats a = cx.blurred(i), b = cy.blurred(i);
            const Floats means = madd(a, a, b * b), ab = a * b;
            const Floats p1 = 2.0f * ab + c1, q1 = means + c1;
            const Floats p2 = 2.0f * (cp.blurred(i) - ab) + c2, q2 = cs.blurred(i) - means + c2;
            const Floats inv1 = reciprocal(q1), inv2 = reciprocal(q2), inv = inv1 * inv2, s = p1 * p2 * inv;
            // S as a function of the blurred x, x^2 + y^2 and x y.
            const Floats dm = 2.0f * inv * (b * (p2 - p1)) - 2.0f * s * a * (inv1 - inv2);
            const Floats ds = -(s * inv2), dc = 2.0f * p1 * inv;
            const int n = width - i;
            const size_t at = (size_t)row * width + i;
            store_part(d_mean + at, dm, n);
            store_part(d_square + at, ds, n);
            store_part(d_cross + at, dc, n);
            row_sum += n >= kLanes ? s : load_part((const float*)&s, n);
        }
        double total = 0;
        for (int l = 0; l < kLanes; l++) total += row_sum[l];
        sum += total;
    }
    return sum;
}

void ssim_gradient_rows(const float* px, const float* py, const float* d_mean, const float* d_square,
                        const float* d_cross, int width, int height, int y0, int y1, float scale, float* out) {
    const int ring = 2 * kRadius + 1;
    Rows line(width, 3);
    Rows bm(width, ring), bs(width, ring), bc(width, ring);
    int next = y0 - kRadius < 0 ? 0 : y0 - kRadius;
    for (int row = y0; row < y1; row++) {
        for (; next <= row + kRadius && next < height; next++) {
            const size_t at = (size_t)next * width;
            std::memcpy(line.row(0), d_mean + at, width * sizeof(float));
            std::memcpy(line.row(1), d_square + at, width * sizeof(float));
            std::memcpy(line.row(2), d_cross + at, width * sizeof(float));
            for (int i = 0; i < width; i += kLanes) {
                store(bm.row(next) + i, across(line.row(0) + i));
                store(bs.row(next) + i, across(line.row(1) + i));
                store(bc.row(next) + i, across(line.row(2) + i));
            }
        }
        const Column cm(bm, row, height), cs(bs, row, height), cc(bc, row, height);
        for (int i = 0; i < width; i += kLanes) {
            const int n = width - i;
            const size_t at = (size_t)row * width + i;
            const Floats x = load_part(px + at, n), y = load_part(py + at, n);
            const Floats g = scale * madd(2.0f * x, cs.blurred(i), madd(y, cc.blurred(i), cm.blurred(i)));
            store_part(out + at, g, n);
        }
    }
}

// ---- normals against a depth map

double normal_rows(const NormalJob& j, int y0, int y1) {
    const size_t plane = (size_t)j.width * j.height;
    const float step_x = 1 / j.fx;
    Floats lane;
    for (int l = 0; l < kLanes; l++) lane[l] = (float)l;
    double sum = 0;
    for (int y = y0; y < y1; y++) {
        const float ry = (y + 0.5f - j.cy) / j.fy, step_y = 1 / j.fy;
        Floats row_sum{};
        for (int x = 1; x < j.width - 1; x += kLanes) {
            const int n = j.width - 1 - x;
            const size_t at = (size_t)y * j.width + x;
            const Floats rx = (((float)x + 0.5f - j.cx) + lane) * step_x;
            const Floats right = load_part(j.depth + at + 1, n), left = load_part(j.depth + at - 1, n);
            const Floats below = load_part(j.depth + at + j.width, n), above = load_part(j.depth + at - j.width, n);
            const Mask valid = lesser(0.0f, right) & lesser(0.0f, left) & lesser(0.0f, below) & lesser(0.0f, above);
            // Differences of the points depth * (rx, ry, 1) across and down; the normal is down x across.
            const Floats across[3] = {right * (rx + step_x) - left * (rx - step_x), (right - left) * ry, right - left};
            const Floats down[3] = {(below - above) * rx, below * (ry + step_y) - above * (ry - step_y), below - above};
            Floats m[3], unit[3], g[3], gm[3];
            for (int c = 0; c < 3; c++) {
                const int a = (c + 1) % 3, b = (c + 2) % 3;
                m[c] = down[a] * across[b] - down[b] * across[a];
            }
            const Floats length2 = higher(m[0] * m[0] + m[1] * m[1] + m[2] * m[2], broadcast(1e-30f));
            const Floats inv = reciprocal(root(length2));
            const Floats alpha = keep(valid, load_part(j.alpha + at, n));
            Floats agreement{};
            for (int c = 0; c < 3; c++) {
                unit[c] = m[c] * inv;
                g[c] = -(alpha * load_part(j.normal + c * plane + at, n));
                agreement = madd(g[c], unit[c], agreement);
                store_part(j.d_normal + c * plane + at, -(keep(valid, alpha * unit[c]) * j.scale), n);
            }
            row_sum += keep(valid, 1.0f + agreement);
            for (int c = 0; c < 3; c++) gm[c] = keep(valid, (g[c] - unit[c] * agreement) * inv * j.scale);
            Floats d_down[3], d_across[3];
            for (int c = 0; c < 3; c++) {
                const int a = (c + 1) % 3, b = (c + 2) % 3;
                d_down[c] = across[a] * gm[b] - across[b] * gm[a];
                d_across[c] = gm[a] * down[b] - gm[b] * down[a];
            }
            const Floats flat = d_across[1] * ry + d_across[2], steep = d_down[0] * rx + d_down[2];
            store_part(j.to_right + at, madd(d_across[0], rx + step_x, flat), n);
            store_part(j.to_left + at, -madd(d_across[0], rx - step_x, flat), n);
            store_part(j.to_below + at, madd(d_down[1], ry + step_y, steep), n);
            store_part(j.to_above + at, -madd(d_down[1], ry - step_y, steep), n);
        }
        for (int l = 0; l < kLanes; l++) sum += row_sum[l];
    }
    return sum;
}

// ---- Adam

void adam(int64_t count, float* value, const float* gradient, float* first, float* second, float rate, float share1,
          float share2, float second_correction, float epsilon) {
    auto update = [&](Floats g, Floats& m, Floats& v, Floats& p) {
        m = madd(g - m, share1, m);
        v = madd(madd(g, g, -v), broadcast(share2), v);
        p = p - rate * m / (root(v) * second_correction + epsilon);
    };
    int64_t i = 0;
    for (; i + kLanes <= count; i += kLanes) {
        Floats m = load(first + i), v = load(second + i), p = load(value + i);
        update(load(gradient + i), m, v, p);
        store(first + i, m);
        store(second + i, v);
        store(value + i, p);
    }
    if (const int64_t n = count - i) {
        Floats g{}, m{}, v{}, p{};
        std::memcpy(&g, gradient + i, n * sizeof(float));
        std::memcpy(&m, first + i, n * sizeof(float));
        std::memcpy(&v, second + i, n * sizeof(float));
        std::memcpy(&p, value + i, n * sizeof(float));
        update(g, m, v, p);
        std::memcpy(first + i, &m, n * sizeof(float));
        std::memcpy(second + i, &v, n * sizeof(float));
        std::memcpy(value + i, &p, n * sizeof(float));
    }
}

void adam_rows(const int64_t* rows, int64_t count, int64_t wide, const float* kept, float* value, const float* gradient,
               float* first, float* second, float rate, float share1, float share2, float second_correction,
               float epsilon) {
    for (int64_t r = 0; r < count;) {  // rows that follow one another are one stretch of memory
        const int64_t begin = r, at = rows[begin] * wide;
        for (bool next = true; next; next = r < count && rows[r] == rows[begin] + r - begin) {
            for (int64_t k = 0; k < wide; k++) second[rows[r] * wide + k] *= kept[r];
            r++;
        }
        adam((r - begin) * wide, value + at, gradient + begin * wide, first + at, second + at, rate, share1, share2,
             second_correction, epsilon);
    }
}

// ---- Moments in 16 bits: the upper halves of floats

inline uint32_t bits_of(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    return bits;
}
inline void widen(int64_t count, const uint16_t* from, float* to) {
    for (int64_t k = 0; k < count; k++) {
        const uint32_t bits = (uint32_t)from[k] << 16;
        std::memcpy(to + k, &bits, sizeof bits);
    }
}
inline void narrow_to_nearest(int64_t count, const float* from, uint16_t* to) {
    for (int64_t k = 0; k < count; k++) {
        const uint32_t bits = bits_of(from[k]);
        to[k] = (uint16_t)((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
    }
}
inline void narrow_dithered(int64_t count, const float* from, uint16_t* to, uint32_t place, uint32_t step) {
    for (int64_t k = 0; k < count; k++) {
        uint32_t h = (place + (uint32_t)k) * 0x9e3779b1u + step * 0x85ebca77u;
        h = (h ^ h >> 16) * 0x7feb352du;
        h = (h ^ h >> 15) * 0x846ca68bu;
        to[k] = (uint16_t)((bits_of(from[k]) + (h >> 16)) >> 16);
    }
}

void adam_short(const int64_t* rows, int64_t count, int64_t wide, const float* kept, float* value,
                const float* gradient, uint16_t* first, uint16_t* second, int64_t origin, uint32_t step, float rate,
                float share1, float share2, float second_correction, float epsilon) {
    const int64_t some = std::max<int64_t>(1, 1024 / wide);  // rows that are widened together
    std::vector<float> m(some * wide), v(some * wide);
    for (int64_t r = 0; r < count;) {
        const int64_t begin = r, at = (rows ? rows[begin] : begin) * wide;
        do r++;
        while (r < count && r - begin < some && (!rows || rows[r] == rows[begin] + r - begin));
        const int64_t n = (r - begin) * wide;
        widen(n, first + at, m.data());
        widen(n, second + at, v.data());
        if (kept)
            for (int64_t k = 0; k < r - begin; k++)
                for (int64_t c = 0; c < wide; c++) v[k * wide + c] *= kept[begin + k];
        adam(n, value + at, gradient + begin * wide, m.data(), v.data(), rate, share1, share2, second_correction,
             epsilon);
        narrow_to_nearest(n, m.data(), first + at);
        narrow_dithered(n, v.data(), second + at, (uint32_t)(origin + at), step);
    }
}

}  // namespace
}  // namespace surfkit
