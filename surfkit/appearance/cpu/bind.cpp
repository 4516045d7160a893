// What Python sees of the camera response: arrays are checked in appearance/camera_response.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <string>
#include <vector>

#include "../../raster/native/pool.h"
#include "respond.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

using Image = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using ImageOut = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Line = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr int kRows = 16;              // of a piece of work
constexpr int64_t kValues = 1 << 16;

const RespondKernels& named(const std::string& name) {
#if defined(SURFKIT_X86)
    if (name == "avx512") return respond_kernels_avx512();
    if (name == "avx2") return respond_kernels_avx2();
#endif
    return respond_kernels_baseline();
}

}  // namespace

void add_appearance(nb::module_& m) {
    // numbers: stops (3), falloff (3), centre (2), curve (3).
    m.def("respond", [](Image color, Line x, Line y, std::vector<double> numbers, ImageOut out, ImageOut slope,
                        const std::string& kernels, int threads) {
        RespondJob job{};
        job.color = color.data(), job.x = x.data(), job.y = y.data(), job.out = out.data(), job.slope = slope.data();
        job.height = (int)color.shape(1), job.width = (int)color.shape(2);
        for (int i = 0; i < 3; i++) {
            job.stops[i] = (float)numbers.at(i), job.falloff[i] = (float)numbers.at(3 + i);
            job.curve[i] = (float)numbers.at(8 + i);
        }
        for (int i = 0; i < 2; i++) job.centre[i] = (float)numbers.at(6 + i);
        const RespondKernels& k = named(kernels);
        nb::gil_scoped_release free;
        parallel((job.height + kRows - 1) / kRows, threads, [&](int64_t i) {
            k.respond(job, (int)i * kRows, std::min(job.height, (int)(i + 1) * kRows));
        });
    });
    m.def("respond_backward", [](Image grad, Image slope, ImageOut out, const std::string& kernels, int threads) {
        const int64_t count = (int64_t)grad.size();
        const float *g = grad.data(), *s = slope.data();
        float* o = out.data();
        const RespondKernels& k = named(kernels);
        nb::gil_scoped_release free;
        parallel((count + kValues - 1) / kValues, threads, [&](int64_t i) {
            const int64_t at = i * kValues;
            k.respond_backward(g + at, s + at, std::min(kValues, count - at), o + at);
        });
    });
}

}  // namespace surfkit
