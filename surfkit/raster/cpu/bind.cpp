// The part of the module that draws: arrays are checked in raster/native.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <string>

#include "pass.h"
#include "rays.h"
#include "../native/pool.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

const Kernels* active = nullptr;

constexpr int64_t kRowsOfAdam = 256;  // updated as one piece of work

using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<bool, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<int64_t, nb::c_contig, nb::device::cpu>;
using Shorts = nb::ndarray<uint16_t, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Optional = std::optional<Array>;

float* data(const Optional& a) { return a ? a->data() : nullptr; }

Planes planes(const std::vector<Optional>& maps) {  // in the order of api.Maps
    return {data(maps.at(0)), data(maps.at(1)), data(maps.at(2)), data(maps.at(3)), data(maps.at(4)), data(maps.at(5))};
}

SplatArrays arrays(const std::vector<Array>& s) {  // in the order of api.Splats.tensors
    return {(int64_t)s.at(0).shape(0),
            s.at(4).ndim() == 2 ? 0 : 1 + (int)s.at(5).shape(1),
            s[0].data(),
            s[1].data(),
            s[2].data(),
            s[3].data(),
            s[4].data(),
            s[5].data()};
}

// Of colours alone: means and the two arrays of coefficients.
SplatArrays shaded(const std::vector<Array>& s) {
    return {(int64_t)s.at(0).shape(0), 1 + (int)s.at(2).shape(1), s[0].data(), nullptr, nullptr, nullptr,
            s[1].data(), s[2].data()};
}

Kind kind_of(bool surfel, splat::Geometry geometry) {
    return surfel ? kSurfel : geometry >= splat::kRay ? kGaussianRay : kGaussian;
}

splat::CameraModel<double> camera(const std::vector<double>& pose, const std::vector<double>& lens, int width,
                                  int height, double near) {
    splat::CameraModel<double> c;
    const auto& m = pose;  // 4 x 4 by rows
    c.turn = {{m.at(0), m.at(4), m.at(8)}, {m.at(1), m.at(5), m.at(9)}, {m.at(2), m.at(6), m.at(10)}};
    c.shift = {m.at(3), m.at(7), m.at(11)};
    c.centre = -1.0 * splat::mul_transposed(c.turn, c.shift);
    c.fx = lens.at(0);
    c.fy = lens.at(1);
    c.cx = lens.at(2);
    c.cy = lens.at(3);
    c.near = near;
    c.width = width;
    c.height = height;
    return c;
}

}  // namespace

const Kernels& kernels() { return *active; }
void use_kernels(const Kernels& k) { active = &k; }

std::vector<const Kernels*> runnable_kernels() {
    std::vector<const Kernels*> found;
#if defined(SURFKIT_X86)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw"))
        found.push_back(&kernels_avx512());
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&kernels_avx2());
#endif
    found.push_back(&kernels_baseline());
    return found;
}

void add_raster(nb::module_& m) {
    use_kernels(*runnable_kernels().front());

    nb::class_<Pass>(m, "Pass")
        .def("__init__",
             [](Pass* self, bool surfel, int geometry, std::vector<Array> splats, std::vector<double> pose, std::vector<double> lens,
                int width, int height, double near, double dilation, bool antialias, double rim, Flags seen, Array radii,
                int threads, int first_row, int end_row) {
                 const auto s = arrays(splats);
                 const auto c = camera(pose, lens, width, height, near);
                 nb::gil_scoped_release free;
                 const GaussianForm form{dilation, antialias, (splat::Geometry)geometry};
                 new (self) Pass(kind_of(surfel, form.geometry), s, c, form, rim, threads, seen.data(), radii.data(),
                                 {first_row, end_row});
             })
        .def_ro("first_invalid", &Pass::first_invalid)
        .def_prop_ro("pairs", &Pass::pairs)
        .def("pairs_by_row", &Pass::pairs_by_row)
        .def("forward",
             [](Pass& self, int level, std::vector<Optional> maps, int threads) {
                 const Planes p = planes(maps);
                 nb::gil_scoped_release free;
                 self.forward((Level)level, p, threads);
             })
        .def(
            "backward",
            [](Pass& self, std::vector<Array> splats, std::vector<Optional> total, std::vector<Optional> chosen,
               bool absolute, int64_t rows, std::vector<Array> out, Array signal, Optional chosen_signal, int threads) {
                const auto s = arrays(splats);
                const Planes t = planes(total), c = chosen.empty() ? Planes{} : planes(chosen);
                const GradientArrays g{out.at(0).data(), out.at(1).data(), out.at(2).data(),   out.at(3).data(),
                                       out.at(4).data(), out.at(5).data(), signal.data(),    data(chosen_signal)};
                const bool part = !chosen.empty();
                nb::gil_scoped_release free;
                self.backward(s, t, part ? &c : nullptr, absolute, rows, g, threads);
            },
            nb::arg("splats"), nb::arg("total"), nb::arg("chosen"), nb::arg("absolute"), nb::arg("rows"),
            nb::arg("out"), nb::arg("signal"), nb::arg("chosen_signal").none(), nb::arg("threads"))
        .def("contribution",
             [](Pass& self, double alpha_power, double open_power, Array sum, Counts count, int threads) {
                 nb::gil_scoped_release free;
                 self.contribution((float)alpha_power, (float)open_power, sum.data(), count.data(), threads);
             })
        .def("leading",
             [](Pass& self, Counts count, int threads) {
                 nb::gil_scoped_release free;
                 self.leading(count.data(), threads);
             })
        .def("probe", [](Pass& self, Points points, Array opacity, int threads) {
            nb::gil_scoped_release free;
            self.probe(points.data(), (int64_t)points.shape(0), opacity.data(), threads);
        });

    m.def("in_view", [](bool surfel, int geometry, Array means, Array scales, std::vector<double> pose,
                        std::vector<double> lens, int width, int height, double near, Flags found, int threads,
                        int first_row, int end_row) {
        const SplatArrays s{(int64_t)means.shape(0), 0, means.data(), nullptr, scales.data()};
        const auto c = camera(pose, lens, width, height, near);
        nb::gil_scoped_release free;
        in_view(kind_of(surfel, (splat::Geometry)geometry), s, c, {first_row, end_row}, threads, found.data());
    });
    m.def("shade", [](std::vector<Array> shading, Counts rows, std::vector<double> pose, std::vector<double> lens,
                      int width, int height, double near, Array rgb, int threads) {
        const SplatArrays s = shaded(shading);
        const auto c = camera(pose, lens, width, height, near);
        nb::gil_scoped_release free;
        shade(s, rows.data(), (int64_t)rows.size(), c, threads, rgb.data());
    });
    m.def("shade_backward", [](std::vector<Array> shading, Counts rows, std::vector<double> pose, std::vector<double> lens,
                               int width, int height, double near, Array by_rgb, Array by_sh0, Array by_sh_rest,
                               Array by_means, int threads) {
        const SplatArrays s = shaded(shading);
        const auto c = camera(pose, lens, width, height, near);
        nb::gil_scoped_release free;
        shade_backward(s, rows.data(), (int64_t)rows.size(), c, threads, by_rgb.data(), by_sh0.data(),
                       by_sh_rest.data(), by_means.data());
    });
    m.def(
        "kernels",
        [] {
            std::vector<std::string> names;
            for (const Kernels* k : runnable_kernels()) names.push_back(k->name);
            return names;
        },
        "Compilations of the kernels that this machine can run, best first.");
    m.def("kernels_in_use", [] { return std::string(kernels().name); });
    m.def("use_kernels", [](const std::string& name) {
        for (const Kernels* k : runnable_kernels())
            if (name == k->name) return use_kernels(*k);
        throw nb::value_error(("no kernels named " + name).c_str());
    });
    m.def("ray_opacity", [](std::vector<Array> splats, std::vector<double> pose, std::vector<double> lens, int width,
                            int height, double near, Points points, bool solid, Array opacity, int threads) {
        const SplatArrays s{(int64_t)splats.at(0).shape(0), 0,       splats[0].data(), splats.at(1).data(),
                            splats.at(2).data(),            splats.at(3).data()};
        const auto c = camera(pose, lens, width, height, near);
        nb::gil_scoped_release free;
        ray_opacity(s, c, points.data(), (int64_t)points.shape(0), solid, opacity.data(), threads);
    });
    m.def(
        "ssim",
        [](Array x, Array y, Optional gradient, int threads) {
            const int channels = (int)x.shape(0), height = (int)x.shape(1), width = (int)x.shape(2);
            const float *px = x.data(), *py = y.data();
            float* g = data(gradient);
            nb::gil_scoped_release free;
            return ssim(px, py, channels, width, height, g, threads);
        },
        nb::arg("x"), nb::arg("y"), nb::arg("gradient").none(), nb::arg("threads"));
    m.def("normal_disagreement", [](Array depth, Array alpha, Array normal, std::vector<double> lens, Array d_depth,
                                    Array d_normal, int threads) {
        NormalJob job{};
        job.depth = depth.data();
        job.alpha = alpha.data();
        job.normal = normal.data();
        job.height = (int)depth.shape(0);
        job.width = (int)depth.shape(1);
        job.fx = (float)lens.at(0);
        job.fy = (float)lens.at(1);
        job.cx = (float)lens.at(2);
        job.cy = (float)lens.at(3);
        job.d_normal = d_normal.data();
        float* g = d_depth.data();
        nb::gil_scoped_release free;
        return normal_disagreement(job, g, threads);
    });
    m.def("adam_rows", [](Array value, Counts rows, Array kept, Array gradient, Array first, Array second, double rate,
                          double beta1, double beta2, double second_correction, double epsilon, int threads) {
        const int64_t n = (int64_t)rows.size(), wide = n ? (int64_t)gradient.size() / n : 0;
        float *p = value.data(), *m1 = first.data(), *m2 = second.data();
        const float *g = gradient.data(), *decay = kept.data();
        const int64_t* row = rows.data();
        nb::gil_scoped_release free;
        parallel(wide ? (n + kRowsOfAdam - 1) / kRowsOfAdam : 0, threads, [&](int64_t piece) {
            const int64_t at = piece * kRowsOfAdam;
            kernels().adam_rows(row + at, std::min(kRowsOfAdam, n - at), wide, decay + at, p, g + at * wide, m1, m2,
                                (float)rate, (float)(1 - beta1), (float)(1 - beta2), (float)second_correction,
                                (float)epsilon);
        });
    });
    m.def("adam_short", [](Array value, std::optional<Counts> rows, std::optional<Array> kept, Array gradient,
                           Shorts first, Shorts second, int64_t origin, int64_t step, double rate, double beta1,
                           double beta2, double second_correction, double epsilon, int threads) {
        const int64_t n = (int64_t)gradient.shape(0), wide = n ? (int64_t)gradient.size() / n : 0;
        float *p = value.data(), *decay = kept ? kept->data() : nullptr;
        uint16_t *m1 = first.data(), *m2 = second.data();
        const float* g = gradient.data();
        const int64_t* row = rows ? rows->data() : nullptr;
        nb::gil_scoped_release free;
        parallel(wide ? (n + kRowsOfAdam - 1) / kRowsOfAdam : 0, threads, [&](int64_t piece) {
            const int64_t at = piece * kRowsOfAdam, here = row ? 0 : at * wide;
            kernels().adam_short(row ? row + at : nullptr, std::min(kRowsOfAdam, n - at), wide,
                                 decay ? decay + at : nullptr, p + here, g + at * wide, m1 + here, m2 + here,
                                 origin + here, (uint32_t)step, (float)rate, (float)(1 - beta1), (float)(1 - beta2),
                                 (float)second_correction, (float)epsilon);
        });
    });
    m.def("adam", [](Array value, Array gradient, Array first, Array second, double rate, double beta1, double beta2,
                     double second_correction, double epsilon, int threads) {
        const int64_t n = (int64_t)value.size(), piece = 1 << 16;
        float *p = value.data(), *m1 = first.data(), *m2 = second.data();
        const float* g = gradient.data();
        nb::gil_scoped_release free;
        parallel((n + piece - 1) / piece, threads, [&](int64_t i) {
            const int64_t at = i * piece;
            kernels().adam(std::min(piece, n - at), p + at, g + at, m1 + at, m2 + at, (float)rate, (float)(1 - beta1),
                           (float)(1 - beta2), (float)second_correction, (float)epsilon);
        });
    });
}

}  // namespace surfkit
