// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table.
//
// Light times a gain is, where both colours lie on the curved part of sRGB, a colour times a factor and plus a constant:
// only pixels that cross its straight part need powers.
#include "respond.h"

#include <algorithm>
#include <cmath>

#include "../../raster/native/simd.h"

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(respond_kernels_, name)

namespace surfkit {
namespace {

constexpr float kOffset = 0.055f, kScale = 1.055f, kPower = 2.4f, kSlope = 12.92f, kKnee = 0.04045f;  // IEC 61966-2-1
constexpr float kLn2 = 0.693147181f;

SURFKIT_INLINE Floats load_some(const float* p, int n) {
    if (n >= kLanes) return load(p);
    Floats v{};
    std::memcpy(&v, p, n * sizeof(float));
    return v;
}
SURFKIT_INLINE void store_some(float* p, Floats v, int n) { std::memcpy(p, &v, std::min(n, kLanes) * sizeof(float)); }

// A colour as it is with `gain` times the light, and its derivative; `root` is gain^(1/2.4).
SURFKIT_INLINE Floats brightened(Floats color, Floats gain, Floats root, Floats& slope) {
    const Mask dark = less_equal(color, kKnee);
    const Floats straight = gain * color, curved = madd(root, color + kOffset, broadcast(-kOffset));
    const Floats out = select(dark, straight, curved);
    slope = select(dark, gain, root);
    const Mask stays = less_equal(out, kKnee);
    const Mask up = without(dark, stays), down = without(stays, dark);
    if (!any(up) && !any(down)) return out;
    const Floats above = higher(straight, broadcast(kKnee));  // of `up`; elsewhere something that has a logarithm
    const Floats up_out =
        madd(exp_negative(log_positive(above / kSlope) / kPower), broadcast(kScale), broadcast(-kOffset));
    const Floats base = higher(color + kOffset, broadcast(kOffset));
    const Floats down_out = kSlope * gain * exp_negative(log_positive(base / kScale) * kPower);
    slope = select(up, (up_out + kOffset) / (kPower * higher(color, broadcast(1e-30f))), slope);
    slope = select(down, kPower * down_out / base, slope);
    return select(up, up_out, select(down, down_out, out));
}

void respond(const RespondJob& j, int y0, int y1) {
    const size_t plane = (size_t)j.width * j.height;
    const float* k = j.curve;
    const bool curved = k[0] != 0 || k[1] != 0 || k[2] != 0;
    float gain[3], root[3];
    for (int c = 0; c < 3; c++) gain[c] = std::exp2(j.stops[c]), root[c] = std::exp2(j.stops[c] / kPower);
    for (int row = y0; row < y1; row++) {
        const float dy = j.y[row] - j.centre[1];
        for (int column = 0; column < j.width; column += kLanes) {
            const int n = j.width - column;
            const size_t at = (size_t)row * j.width + column;
            const Floats dx = load_some(j.x + column, n) - j.centre[0], r2 = madd(dx, dx, broadcast(dy * dy));
            const Floats stops = r2 * madd(r2, madd(r2, j.falloff[2], j.falloff[1]), broadcast(j.falloff[0]));
            const Floats nepers = higher(lower(stops, broadcast(100.0f)), broadcast(-100.0f)) * -kLn2;
            const Floats shade = exp_negative(nepers), shade_root = exp_negative(nepers / kPower);
            for (int c = 0; c < 3; c++) {
                Floats slope;
                Floats v = brightened(load_some(j.color + c * plane + at, n), shade * gain[c], shade_root * root[c], slope);
                const Mask over = lesser(1.0f, v);
                v = lower(v, broadcast(1.0f));
                if (curved) {
                    const Floats u = 1.0f - 2.0f * higher(v, Floats{}), uu = u * u, bow = 0.25f * (1.0f - uu);
                    v = madd(bow, k[0] + u * k[1] + (0.25f * k[2]) * (5.0f * uu - 1.0f), v);
                    slope *= 1.0f + k[0] * u + (0.5f * k[1]) * (3.0f * uu - 1.0f) + (0.5f * k[2]) * u * (5.0f * uu - 3.0f);
                }
                store_some(j.out + c * plane + at, v, n);
                store_some(j.slope + c * plane + at, select(over, -slope, slope), n);
            }
        }
    }
}

void respond_backward(const float* grad, const float* slope, int64_t count, float* out) {
    for (int64_t i = 0; i < count; i += kLanes) {
        const int n = (int)std::min<int64_t>(kLanes, count - i);
        const Floats g = load_some(grad + i, n), s = load_some(slope + i, n);
        store_some(out + i, select(lesser(s, 0.0f) & lesser(g, 0.0f), Floats{}, g * magnitude(s)), n);
    }
}

}  // namespace

const RespondKernels& SURFKIT_TABLE(SURFKIT_KERNELS)() {
    static const RespondKernels table{respond, respond_backward};
    return table;
}

}  // namespace surfkit
