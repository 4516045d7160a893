// What Python sees of the codebooks: arrays are checked in compress/kmeans.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "../../raster/native/pool.h"
#include "nearest.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

using Floats = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Order = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Known = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Distance = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Places = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Sums = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

const NearestKernels& named(const std::string& name) {
#if defined(SURFKIT_X86)
    if (name == "avx512") return nearest_kernels_avx512();
    if (name == "avx2") return nearest_kernels_avx2();
#endif
    return nearest_kernels_baseline();
}

constexpr float kFar = 3e38f;   // score of what fills the last block
constexpr float kAway = 1e18f;  // its place; vectors lie within 1e15

// A codebook in blocks of codes, those that follow one another in `order` together.
class Codebook {
  public:
    Codebook(Floats values, Floats features, Order order) {
        const int64_t count = (int64_t)values.shape(0), dimensions = (int64_t)values.shape(1), used = (int64_t)features.shape(1);
        const int64_t blocks = (count + kBlock - 1) / kBlock;
        value_.assign(blocks * dimensions * kBlock, kAway);
        minus_.assign(blocks * used * kBlock, 0.0f);
        half_.assign(blocks * kBlock, kFar);
        index_.assign(blocks * kBlock, -1);
        radius_.assign(blocks, 0.0f);
        for (int64_t at = 0; at < count; at++) {
            const int64_t code = order.data()[at], block = at / kBlock, lane = at % kBlock;
            double square = 0;
            for (int64_t j = 0; j < dimensions; j++)
                value_[(block * dimensions + j) * kBlock + lane] = values.data()[code * dimensions + j];
            for (int64_t j = 0; j < used; j++) {
                const float feature = features.data()[code * used + j];
                minus_[(block * used + j) * kBlock + lane] = -feature;
                square += (double)feature * (double)feature;
            }
            index_[at] = (int32_t)code;
            half_[at] = (float)(square / 2);
            radius_[block] = std::max(radius_[block], (float)std::sqrt(square));
        }
        codes_ = {(int)dimensions,  (int)used,     (int)blocks,  value_.data(),
                  index_.data(), minus_.data(), half_.data(), radius_.data()};
    }

    void nearest(Floats vectors, Floats features, std::optional<Known> without, Index index, Distance distance,
                 const std::string& kernels, int threads) const {
        const NearestJob job{codes_, vectors.data(), features.data(), without ? without->data() : nullptr,
                             (int64_t)vectors.shape(0), index.data(), distance.data()};
        const NearestKernels& k = named(kernels);
        nb::gil_scoped_release free;
        const int64_t tiles = (job.rows + k.rows - 1) / k.rows, share = 8;
        parallel((tiles + share - 1) / share, threads, [&](int64_t i) {
            NearestScratch scratch;
            for (int64_t tile = i * share; tile < std::min(tiles, (i + 1) * share); tile++) k.nearest(job, tile * k.rows, scratch);
        });
    }

  private:
    std::vector<float> value_, minus_, half_, radius_;
    std::vector<int32_t> index_;
    Codes codes_;
};

// Weighted sums of the vectors of each code, in the order of the vectors, and of their weights in the last column.
void sum_by_code(Floats vectors, Weights weights, Known index, Sums sums, int threads) {
    const int64_t rows = (int64_t)vectors.shape(0), dimensions = (int64_t)vectors.shape(1), codes = (int64_t)sums.shape(0);
    const float* v = vectors.data();
    const double* w = weights.data();
    const int32_t* code = index.data();
    double* out = sums.data();
    nb::gil_scoped_release free;
    const int64_t share = (codes + threads - 1) / threads;
    parallel(threads, threads, [&](int64_t piece) {
        for (int64_t row = 0; row < rows; row++) {
            if (code[row] / share != piece) continue;
            double* sum = out + code[row] * (dimensions + 1);
            for (int64_t j = 0; j < dimensions; j++) sum[j] += w[row] * (double)v[row * dimensions + j];
            sum[dimensions] += w[row];
        }
    });
}

// Twice the code of each vector, and one more where it lies ahead of the middle of the code in its direction. In place.
void halve(Floats vectors, Places middles, Places directions, Index index, int threads) {
    const int64_t rows = (int64_t)vectors.shape(0), dimensions = (int64_t)vectors.shape(1), share = 4096;
    const float* v = vectors.data();
    const double *middle = middles.data(), *direction = directions.data();
    int32_t* code = index.data();
    nb::gil_scoped_release free;
    parallel((rows + share - 1) / share, threads, [&](int64_t piece) {
        for (int64_t row = piece * share; row < std::min(rows, (piece + 1) * share); row++) {
            const int64_t at = code[row] * dimensions;
            double ahead = 0;
            for (int64_t j = 0; j < dimensions; j++)
                ahead += ((double)v[row * dimensions + j] - middle[at + j]) * direction[at + j];
            code[row] = 2 * code[row] + (ahead > 0);
        }
    });
}

}  // namespace

void add_compress(nb::module_& m) {
    nb::class_<Codebook>(m, "Codebook")
        .def(nb::init<Floats, Floats, Order>(), nb::arg("values"), nb::arg("features"), nb::arg("order"))
        .def("nearest", &Codebook::nearest, nb::arg("vectors"), nb::arg("features"), nb::arg("without").none(), nb::arg("index"),
             nb::arg("distance"), nb::arg("kernels"), nb::arg("threads"));
    m.def("sum_by_code", &sum_by_code, nb::arg("vectors"), nb::arg("weights"), nb::arg("index"), nb::arg("sums"),
          nb::arg("threads"));
    m.def("halve", &halve, nb::arg("vectors"), nb::arg("middles"), nb::arg("directions"), nb::arg("index"), nb::arg("threads"));
}

}  // namespace surfkit
