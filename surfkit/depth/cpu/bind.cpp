// What Python sees of the stereo: arrays are checked in depth/native.py, which alone calls this.

#if defined(SURFKIT_X86)
#include <cpuid.h>
#endif
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "../../raster/native/pool.h"
#include "agreement.h"
#include "stereo.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Made = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Pairs = nb::ndarray<const uint16_t, nb::c_contig, nb::device::cpu>;

#if defined(SURFKIT_X86)
// Intel processors with half-precision AVX-512 (Sapphire Rapids and later) gather sixteen words in less than half of the
// time that insertions take. Earlier ones have microcode against Gather Data Sampling, which makes that instruction slow.
bool gathers_quickly() {
    unsigned a, b, c, d;
    constexpr unsigned kHalfPrecision = 1u << 23;
    return __get_cpuid_count(7, 0, &a, &b, &c, &d) && (d & kHalfPrecision) && __builtin_cpu_is("intel");
}
#endif

// "avx512_insert" and "avx512_gather" are what "avx512" chooses from.
const StereoKernels& named(const std::string& name) {
#if defined(SURFKIT_X86)
    static const bool gather = gathers_quickly();
    if (name == "avx512_gather" || (name == "avx512" && gather)) return stereo_kernels_avx512_gather();
    if (name == "avx512_insert" || name == "avx512") return stereo_kernels_avx512();
    if (name == "avx2") return stereo_kernels_avx2();
#endif
    return stereo_kernels_baseline();
}

}  // namespace

void add_stereo(nb::module_& m) {
    m.def(
        "patch_match",
        [](Floats image, std::vector<double> lens, Floats pattern, std::vector<Pairs> pixels, std::vector<std::vector<double>> ways,
           std::vector<double> gains, std::vector<std::optional<Floats>> inverse, nb::ndarray<float, nb::c_contig, nb::device::cpu> plane,
           nb::ndarray<float, nb::c_contig, nb::device::cpu> cost,
           nb::ndarray<uint8_t, nb::c_contig, nb::device::cpu> each, std::vector<double> settings, int samples, int best, bool survey,
           uint32_t seed, const std::string& kernels, int threads) {
            std::vector<StereoSource> sources(pixels.size());
            for (size_t i = 0; i < pixels.size(); i++) {
                StereoSource& s = sources[i];
                s.pixels = pixels[i].data();
                s.stride = (int)pixels[i].shape(1);
                s.height = (int)pixels[i].shape(0) - 2 * kBorder;
                s.gain = (float)gains.at(i);
                s.width = s.stride - 2 * kBorder - 1;
                const std::vector<double>& way = ways.at(i);
                for (int j = 0; j < 12; j++) s.way[j] = (float)way.at(j), s.back[j] = (float)way.at(12 + j);
                const std::optional<Floats>& map = inverse.at(i);
                s.inverse = map ? map->data() : nullptr;
                s.inverse_height = map ? (int)map->shape(0) : 0;
                s.inverse_width = map ? (int)map->shape(1) : 0;
                s.to_inverse[0] = (float)s.inverse_width / (float)s.width;
                s.to_inverse[1] = (float)s.inverse_height / (float)s.height;
            }
            StereoJob job{};
            job.image = image.data();
            job.height = (int)cost.shape(0);
            job.width = (int)cost.shape(1);
            job.fx = (float)lens.at(0), job.fy = (float)lens.at(1), job.cx = (float)lens.at(2), job.cy = (float)lens.at(3);
            job.offset_x = pattern.data(), job.offset_y = pattern.data() + kSamples, job.nearness = pattern.data() + 2 * kSamples;
            job.sources = sources.data();
            job.views = (int)sources.size();
            job.plane = plane.data();
            job.cost = cost.data();
            job.each = each.data();
            job.low = (float)settings.at(0), job.high = (float)settings.at(1);
            job.parallax = (float)settings.at(2);
            job.jitter_px = (float)settings.at(3);
            job.smoothness = (float)settings.at(4);
            job.consistency = (float)settings.at(5);
            job.spread = (float)settings.at(6);
            job.brightness = (float)settings.at(7);
            for (int i = 0; i < 256; i++) job.alike[i] = std::exp(-(float)i / job.spread);
            float reach = 1;
            for (int i = 0; i < 2 * kSamples; i++) reach = std::max(reach, std::abs(pattern.data()[i]));
            job.stretch = (kBorder - 2) / reach;
            job.samples = samples;
            job.best = best;
            job.survey = survey;
            job.seed = seed;
            const StereoKernels& k = named(kernels);
            const int rows = 4;
            nb::gil_scoped_release free;
            for (int colour = 0; colour < 2; colour++)
                parallel((job.height + rows - 1) / rows, threads, [&](int64_t piece) {
                    for (int row = (int)piece * rows; row < std::min(job.height, (int)(piece + 1) * rows); row++)
                        k.improve(job, row, colour);
                });
        },
        nb::arg("image"), nb::arg("lens"), nb::arg("pattern"), nb::arg("pixels"), nb::arg("ways"), nb::arg("gains"), nb::arg("inverse"), nb::arg("plane"),
        nb::arg("cost"), nb::arg("each"), nb::arg("settings"), nb::arg("samples"), nb::arg("best"), nb::arg("survey"), nb::arg("seed"), nb::arg("kernels"),
        nb::arg("threads"));
    m.def(
        "depth_agreement",
        [](Floats inverse, std::vector<double> lens, std::vector<Floats> others, std::vector<std::vector<double>> ways, double tolerance,
           Made count, Made shown, Made fused, int threads) {
            AgreementJob job{};
            job.inverse = inverse.data();
            job.height = (int)inverse.shape(0), job.width = (int)inverse.shape(1);
            job.fx = lens.at(0), job.fy = lens.at(1), job.cx = lens.at(2), job.cy = lens.at(3);
            for (size_t i = 0; i < others.size(); i++) {
                AgreementMap map{others[i].data(), (int)others[i].shape(1), (int)others[i].shape(0), {}};
                for (int j = 0; j < 12; j++) map.way[j] = ways.at(i).at(j);
                job.others.push_back(map);
            }
            job.tolerance = (float)tolerance;
            job.count = count.data(), job.shown = shown.data(), job.fused = fused.data();
            nb::gil_scoped_release free;
            parallel(job.height, threads, [&](int64_t row) { agreement(job, (int)row); });
        },
        nb::arg("inverse"), nb::arg("lens"), nb::arg("others"), nb::arg("ways"), nb::arg("tolerance"), nb::arg("count"), nb::arg("shown"),
        nb::arg("fused"), nb::arg("threads"));
    m.attr("STEREO_SAMPLES") = kSamples;
    m.attr("STEREO_RADIUS") = kRadius;
    m.attr("STEREO_BORDER") = kBorder;
    m.attr("STEREO_MOST_VIEWS") = kMostViews;
}

}  // namespace surfkit
