// What Python sees of it: arrays are checked in start/carve.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <vector>

#include "carve.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

template <class T>
CarveGrid grid_of(const Array<T>& voxels) {
    return {{(int)voxels.shape(0), (int)voxels.shape(1), (int)voxels.shape(2)}};
}

}  // namespace

void add_start(nb::module_& m) {
    m.def("carve", [](Array<uint8_t> surfaces, Array<uint8_t> through, Array<const float> depth, std::vector<double> lens,
                      std::vector<double> way, std::vector<int> low, std::vector<int> high, int threads) {
        CarveView view{depth.data(), (int)depth.shape(1), (int)depth.shape(0), lens.at(0), lens.at(1), lens.at(2), lens.at(3), {},
                       way.at(12),   way.at(13),          {low.at(0), low.at(1)}, {high.at(0), high.at(1)}};
        std::copy_n(way.begin(), 12, view.pose);
        const CarveGrid grid = grid_of(surfaces);
        nb::gil_scoped_release free;
        carve(grid, view, surfaces.data(), through.data(), threads);
    });
    m.def("meet", [](Array<const uint8_t> solid, std::vector<double> from, Array<const float> rays, Array<float> lengths,
                     Array<float> outward, int threads) {
        const CarveGrid grid = grid_of(solid);
        nb::gil_scoped_release free;
        meet(grid, solid.data(), from.data(), rays.data(), (int64_t)rays.shape(0), lengths.data(), outward.data(), threads);
    });
}

}  // namespace surfkit
