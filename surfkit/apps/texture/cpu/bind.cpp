// What Python sees of it: arrays are checked in texture/look.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "look.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

}  // namespace

void add_texture(nb::module_& m) {
    m.def("look", [](Array<const float> vertices, Array<const int32_t> faces, Array<const float> depth,
                     Array<const uint8_t> color, float slack, Array<int32_t> covered, Array<int32_t> hidden,
                     Array<float> sums, int threads) {
        const LookJob job{vertices.data(),     faces.data(),   (int64_t)faces.shape(0), depth.data(),
                          color.data(),        (int)depth.shape(1), (int)depth.shape(0),     slack,
                          covered.data(),      hidden.data(),  sums.data()};
        nb::gil_scoped_release free;
        look(job, threads);
    });
}

}  // namespace surfkit
