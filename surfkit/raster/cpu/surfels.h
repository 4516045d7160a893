// Projection of surfels, several at once, and its gradients. Part of kernels.cpp.
#pragma once

#include <algorithm>

#include "kernels.h"
#include "lanes.h"

namespace surfkit {
namespace {

// Values of up to kWide splats; lanes without one repeat the last.
splat::SplatIn<Wide> read_some(const SplatArrays& s, const int64_t* rows, int count) {
    double all[10][kWide];
    for (int lane = 0; lane < kWide; lane++) {
        const int64_t i = rows[std::min(lane, count - 1)];
        for (int k = 0; k < 3; k++) all[k][lane] = s.means[3 * i + k];
        for (int k = 0; k < 4; k++) all[3 + k][lane] = s.quats[4 * i + k];
        for (int k = 0; k < 2; k++) all[7 + k][lane] = s.scales[2 * i + k];
        all[9][lane] = s.opacities[i];
    }
    Wide o[10];
    std::memcpy(o, all, sizeof all);
    return {{o[0], o[1], o[2]}, {o[3], o[4], o[5], o[6]}, {o[7], o[8], 0.0}, o[9]};
}

splat::CameraModel<Wide> for_all_lanes(const splat::CameraModel<double>& c) {
    const auto wide = [](splat::Vec<double> v) { return splat::Vec<Wide>{v.x, v.y, v.z}; };
    return {{wide(c.turn.c0), wide(c.turn.c1), wide(c.turn.c2)},
            wide(c.shift),
            wide(c.centre),
            c.fx,
            c.fy,
            c.cx,
            c.cy,
            c.near,
            c.width,
            c.height};
}

void project_surfels(const SplatArrays& splats, const int64_t* rows, int64_t count,
                     const splat::CameraModel<double>& camera, splat::SurfelView<double>* out, bool* drawn) {
    const splat::CameraModel<Wide> cam = for_all_lanes(camera);
    for (int64_t at = 0; at < count; at += kWide) {
        const int some = (int)std::min<int64_t>(kWide, count - at);
        splat::SurfelView<Wide> view;
        const WideMask there = splat::surfel_view(read_some(splats, rows + at, some), cam, view);
        for (int lane = 0; lane < some; lane++) drawn[at + lane] = there.m[lane] != 0;
        take_lanes(view, some, out + at);
    }
}

void surfels_backward(const SplatArrays& splats, const int64_t* rows, int64_t count,
                      const splat::CameraModel<double>& camera, const double* sums, int stride,
                      splat::SplatGrad<double>* out) {
    constexpr int kSums = sizeof(splat::SurfelSums<double>) / sizeof(double);
    const splat::CameraModel<Wide> cam = for_all_lanes(camera);
    for (int64_t at = 0; at < count; at += kWide) {
        const int some = (int)std::min<int64_t>(kWide, count - at);
        double all[kSums][kWide];
        for (int lane = 0; lane < kWide; lane++)
            for (int k = 0; k < kSums; k++) all[k][lane] = sums[(at + std::min(lane, some - 1)) * stride + k];
        splat::SurfelSums<Wide> given;
        std::memcpy(&given, all, sizeof all);
        const splat::SplatIn<Wide> in = read_some(splats, rows + at, some);
        splat::SplatGrad<Wide> gradient;
        splat::surfel_gradient(in, cam, given, gradient);
        take_lanes(gradient, some, out + at);
    }
}

}  // namespace
}  // namespace surfkit
