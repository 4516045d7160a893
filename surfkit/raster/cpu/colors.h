// Colours of splats, several at once, and their gradients: `shade` and `shade_backward` of ../project.h with the same
// bits. Part of kernels.cpp.
#pragma once

#include <algorithm>
#include <type_traits>

#include "surfels.h"

namespace surfkit {
namespace {

// Red, green, blue, and a number that means nothing.
typedef float Channels __attribute__((vector_size(16)));
typedef double WideChannels __attribute__((vector_size(32)));

SURFKIT_INLINE WideChannels for_all_channels(double x) { return WideChannels{x, x, x, x}; }

// Coefficient k of `count`, of the splat of a row. Behind the last one there may be nothing to be read or written.
template <int count>
SURFKIT_INLINE WideChannels coefficient(const SplatArrays& s, int64_t row, int k) {
    const float* at = k ? s.sh_rest + 3 * ((count - 1) * row + k - 1) : s.sh0 + 3 * row;
    Channels v;
    if (k && k + 1 < count) {
        std::memcpy(&v, at, sizeof v);
    } else {
        v = Channels{at[0], at[1], at[2], 0};
    }
    return __builtin_convertvector(v, WideChannels);
}
template <int count>
SURFKIT_INLINE void put_coefficient(WideChannels value, float* sh0, float* sh_rest, int64_t row, int k) {
    const Channels v = __builtin_convertvector(value, Channels);
    float* at = k ? sh_rest + 3 * ((count - 1) * row + k - 1) : sh0 + 3 * row;
    std::memcpy(at, &v, k && k + 1 < count ? sizeof v : 3 * sizeof *at);
}

// The sights of up to kWide splats; lanes without one repeat the last. `basis[k][lane]` has the harmonics.
SURFKIT_INLINE splat::Sight<Wide> sight_of_some(const SplatArrays& s, const int64_t* rows, int some,
                                                const splat::CameraModel<Wide>& cam, double (*basis)[kWide]) {
    double all[3][kWide];
    for (int lane = 0; lane < kWide; lane++)
        for (int k = 0; k < 3; k++) all[k][lane] = s.means[3 * rows[std::min(lane, some - 1)] + k];
    splat::Vec<Wide> mean;
    std::memcpy(&mean, all, sizeof all);
    const splat::Sight<Wide> o = splat::sight(mean - cam.centre, s.coefficients);
    std::memcpy(basis, o.basis, s.coefficients * sizeof(Wide));
    return o;
}

template <int count>
SURFKIT_INLINE WideChannels color_of(const SplatArrays& s, int64_t row, const double (*basis)[kWide], int lane) {
    WideChannels rgb = for_all_channels(0.5);
#pragma GCC unroll 16
    for (int k = 0; k < count; k++) rgb += for_all_channels(basis[k][lane]) * coefficient<count>(s, row, k);
    return rgb;
}

template <int coefficients>
void shade_some_of(const SplatArrays& s, const int64_t* rows, int64_t count, const splat::CameraModel<double>& camera,
                   double (*rgb)[3]) {
    const splat::CameraModel<Wide> cam = for_all_lanes(camera);
    for (int64_t at = 0; at < count; at += kWide) {
        const int some = (int)std::min<int64_t>(kWide, count - at);
        double basis[16][kWide];
        sight_of_some(s, rows + at, some, cam, basis);
        for (int lane = 0; lane < some; lane++) {
            const WideChannels color = color_of<coefficients>(s, rows[at + lane], basis, lane);
            std::memcpy(rgb[at + lane], &color, sizeof rgb[0]);
        }
    }
}

template <int coefficients>
void shade_some_backward_of(const SplatArrays& s, const int64_t* rows, int64_t count,
                            const splat::CameraModel<double>& camera, const double* rgb, int stride, float* out_sh0,
                            float* out_sh_rest, splat::SplatGrad<double>* out) {
    const splat::CameraModel<Wide> cam = for_all_lanes(camera);
    for (int64_t at = 0; at < count; at += kWide) {
        const int some = (int)std::min<int64_t>(kWide, count - at);
        double basis[16][kWide], weight[16][kWide] = {};
        const splat::Sight<Wide> sight = sight_of_some(s, rows + at, some, cam, basis);
        for (int lane = 0; lane < some; lane++) {
            const int64_t row = rows[at + lane];
            const WideChannels color = color_of<coefficients>(s, row, basis, lane);
            const double* given = rgb + (at + lane) * stride;
            WideChannels g{};
            for (int c = 0; c < 3; c++) g[c] = color[c] > 0 ? given[c] : 0;
#pragma GCC unroll 16
            for (int k = 0; k < coefficients; k++) {
                put_coefficient<coefficients>(g * for_all_channels(basis[k][lane]), out_sh0, out_sh_rest, row, k);
                const WideChannels share = g * coefficient<coefficients>(s, row, k);
                for (int c = 0; c < 3; c++) weight[k][lane] += share[c];
            }
        }
        if (coefficients == 1) continue;
        Wide by_basis[16];
        std::memcpy(by_basis, weight, sizeof weight);
        const splat::Vec<Wide> mean = splat::sight_backward(sight, coefficients, by_basis);
        for (int lane = 0; lane < some; lane++)
            if (sight.length.v[lane] > 0)
                out[at + lane].mean =
                    out[at + lane].mean + splat::Vec<double>{mean.x.v[lane], mean.y.v[lane], mean.z.v[lane]};
    }
}

template <class F>
void of_coefficients(int count, F f) {
    if (count == 1) f(std::integral_constant<int, 1>());
    if (count == 4) f(std::integral_constant<int, 4>());
    if (count == 9) f(std::integral_constant<int, 9>());
    if (count == 16) f(std::integral_constant<int, 16>());
}
void shade_some(const SplatArrays& s, const int64_t* rows, int64_t count, const splat::CameraModel<double>& camera,
                double (*rgb)[3]) {
    of_coefficients(s.coefficients, [&](auto n) { shade_some_of<n>(s, rows, count, camera, rgb); });
}
void shade_some_backward(const SplatArrays& s, const int64_t* rows, int64_t count,
                         const splat::CameraModel<double>& camera, const double* rgb, int stride, float* out_sh0,
                         float* out_sh_rest, splat::SplatGrad<double>* out) {
    of_coefficients(s.coefficients, [&](auto n) {
        shade_some_backward_of<n>(s, rows, count, camera, rgb, stride, out_sh0, out_sh_rest, out);
    });
}

}  // namespace
}  // namespace surfkit
