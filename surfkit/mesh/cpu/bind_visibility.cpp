// What Python sees of tetrahedra, votes and cuts: mesh/visibility.py and mesh/delaunay.py alone call this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <numeric>
#include <vector>

#include "../../raster/native/pool.h"
#include "cut.h"
#include "delaunay.h"
#include "grid.h"
#include "visibility.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

template <class T>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

constexpr int64_t PIECE = 1 << 12;

template <class T>
nb::ndarray<nb::numpy, T> given(std::vector<T>&& values, std::vector<size_t> shape) {
    auto* kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete (std::vector<T>*)p; });
    return nb::ndarray<nb::numpy, T>(kept->data(), shape.size(), shape.data(), owner);
}

Pose pose_of(const std::vector<double>& m) {
    return {{{m.at(0), m.at(1), m.at(2)}, {m.at(4), m.at(5), m.at(6)}, {m.at(8), m.at(9), m.at(10)}},
            {m.at(3), m.at(7), m.at(11)}};
}

// The arrays of a view, in the order of Sight.arrays in mesh/sights.py.
Sight sight_of(const In<float>& depth, const In<float>& weight, const In<float>& normal, const In<uint8_t>& color,
               const std::vector<double>& lens, const std::vector<double>& m) {
    Sight s;
    s.depth = depth.data(), s.weight = weight.data(), s.normal = normal.data(), s.color = color.data();
    s.maps = (int)depth.shape(0);
    s.lens = {(int)depth.shape(2), (int)depth.shape(1),  (float)lens.at(0), (float)lens.at(1),
              (float)lens.at(2),   (float)lens.at(3)};
    s.pose = pose_of(m);
    return s;
}

// Pieces of `PIECE` places each, but for those whose boxes (pieces, 6) the view does not see.
template <class Job>
void in_pieces(const Job& job, const Sight& sight, const In<float>& boxes, int64_t count, int threads,
               void (*body)(const Job&, const Sight&, int64_t, int64_t)) {
    const float* box = boxes.data();
    nb::gil_scoped_release free;
    parallel((int64_t)boxes.shape(0), threads, [&](int64_t at) {
        if (may_see(sight, box + 6 * at, box + 6 * at + 3)) body(job, sight, at * PIECE, std::min(count, (at + 1) * PIECE));
    });
}

template <class Body>
void for_each(int64_t count, int threads, const Body& body) {
    nb::gil_scoped_release free;
    parallel((count + PIECE - 1) / PIECE, threads, [&](int64_t piece) {
        for (int64_t i = piece * PIECE; i < std::min(count, (piece + 1) * PIECE); i++) body(i);
    });
}

}  // namespace

void add_visibility(nb::module_& m) {
    m.attr("CELL_BITS") = CELL_BITS;
    m.attr("CUT_UNITS") = UNITS;
    nb::class_<Cells>(m, "Cells")
        .def("__init__",
             [](Cells* self, double side, std::vector<int64_t> low, std::vector<int64_t> high) {
                 new (self) Cells();
                 self->side = side;
                 for (int i = 0; i < 3; i++) self->low[i] = low.at(i), self->high[i] = high.at(i);
             })
        .def("add",
             [](Cells& self, In<float> depth, In<float> weight, In<float> normal, In<uint8_t> color,
                std::vector<double> lens, std::vector<double> pose, double limit) {
                 const Sight sight = sight_of(depth, weight, normal, color, lens, pose);
                 nb::gil_scoped_release free;
                 self.add(sight, limit);
             })
        .def_prop_ro("count", [](const Cells& self) { return self.rows; })
        .def("rows", [](const Cells& self) {  // by their keys
            std::vector<int64_t> order(self.rows), keys(self.rows);
            std::vector<double> sums(self.sums.size());
            {
                nb::gil_scoped_release free;
                std::iota(order.begin(), order.end(), 0);
                std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return self.keys[a] < self.keys[b]; });
                const int64_t values = self.rows ? (int64_t)self.sums.size() / self.rows : 0;
                for (int64_t row = 0; row < self.rows; row++) {
                    keys[row] = self.keys[order[row]];
                    std::copy_n(&self.sums[values * order[row]], values, &sums[values * row]);
                }
            }
            const size_t rows = (size_t)self.rows, values = rows ? sums.size() / rows : 10;
            return nb::make_tuple(given(std::move(keys), {rows}), given(std::move(sums), {rows, values}));
        });
    m.attr("PIECE") = PIECE;
    m.def("vote", [](In<float> places, In<float> boxes, double noise, double thickness, Out<float> empty, Out<float> full, In<float> depth,
                     In<float> weight, In<float> normal, In<uint8_t> color, std::vector<double> lens,
                     std::vector<double> pose, int threads) {
        const VoteJob job{places.data(), (float)noise, (float)thickness, empty.data(), full.data()};
        const Sight sight = sight_of(depth, weight, normal, color, lens, pose);
        in_pieces(job, sight, boxes, (int64_t)places.shape(0), threads, vote);
    });
    m.def("may_see", [](std::vector<float> box, int width, int height, std::vector<double> lens, std::vector<double> m) {
        Sight s{};
        s.lens = {width, height, (float)lens.at(0), (float)lens.at(1), (float)lens.at(2), (float)lens.at(3)};
        s.pose = pose_of(m);
        return may_see(s, box.data(), box.data() + 3);
    });
    m.def("confirm", [](In<float> places, In<float> boxes, In<float> normals, double tolerance, Out<float> views, In<float> depth, In<float> weight, In<float> normal, In<uint8_t> color, std::vector<double> lens,
                        std::vector<double> pose, int threads) {
        const ConfirmJob job{places.data(), normals.data(), (float)tolerance, views.data()};
        in_pieces(job, sight_of(depth, weight, normal, color, lens, pose), boxes, (int64_t)places.shape(0), threads, confirm);
    });
    m.def("pull", [](In<float> places, In<float> boxes, In<float> normals, double reach, double near, Out<float> sum, Out<float> total,
                     Out<float> square, Out<float> views, In<float> depth, In<float> weight, In<float> normal, In<uint8_t> color,
                     std::vector<double> lens, std::vector<double> pose, int threads) {
        const PullJob job{places.data(), normals.data(), (float)reach, (float)near,
                          sum.data(),    total.data(),   square.data(), views.data()};
        in_pieces(job, sight_of(depth, weight, normal, color, lens, pose), boxes, (int64_t)places.shape(0), threads, pull);
    });
    m.def("tetrahedralise", [](In<double> points, double step) {
        Tetrahedra found;
        {
            nb::gil_scoped_release free;
            found = tetrahedralise(points.data(), (int64_t)points.shape(0), step);
        }
        const size_t count = found.corners.size() / 4;
        return nb::make_tuple(given(std::move(found.corners), {count, 4}), given(std::move(found.neighbours), {count, 4}),
                              given(std::move(found.enclosing), {4, 3}), found.left_out);
    });
    m.def("least_step", [](In<double> points) { return least_step(points.data(), (int64_t)points.shape(0)); });
    m.def("locate", [](In<double> points, In<int32_t> corners, In<int32_t> neighbours, In<double> places,
                       In<int32_t> starts, Out<int32_t> found, int threads) {
        const Walk walk{points.data(), corners.data(), neighbours.data()};
        const double* place = places.data();
        const int32_t* start = starts.data();
        int32_t* out = found.data();
        for_each((int64_t)places.shape(0), threads, [&](int64_t i) { out[i] = locate(walk, place + 3 * i, start[i]); });
    });
    m.def("volumes", [](In<double> points, In<int32_t> corners, Out<double> found, int threads) {
        const Walk walk{points.data(), corners.data(), nullptr};
        double* out = found.data();
        for_each((int64_t)corners.shape(0), threads, [&](int64_t i) { out[i] = volume(walk, i); });
    });
    m.def("price", [](In<double> points, In<int32_t> corners, In<int32_t> neighbours, In<float> normals,
                      In<float> evidence, double side, double aligned, double sure, double certain, Out<int32_t> cost,
                      int threads) {
        const Walk walk{points.data(), corners.data(), neighbours.data()};
        const CostJob job{normals.data(), evidence.data(), (int64_t)normals.shape(0), side, (float)aligned,
                          (float)sure,    (float)certain,  cost.data()};
        for_each((int64_t)corners.shape(0), threads, [&](int64_t i) { price(job, walk, i); });
    });
    m.def("minimum_cut", [](In<int32_t> neighbours, In<int32_t> pair, In<int64_t> bias, Out<uint8_t> side) {
        const CutJob job{(int64_t)neighbours.shape(0), neighbours.data(), pair.data(), bias.data(), side.data()};
        nb::gil_scoped_release free;
        return minimum_cut(job);
    });
}

}  // namespace surfkit
