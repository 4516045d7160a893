// What Python sees of the grid: arrays are checked in mesh/native.py, which alone calls this.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstring>
#include <optional>
#include <string>

#include "../../raster/native/pool.h"
#include "agree.h"
#include "collapse.h"
#include "grid.h"
#include "shade.h"

namespace nb = nanobind;

namespace surfkit {
namespace {

using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Words = nb::ndarray<const uint32_t, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const int8_t, nb::c_contig, nb::device::cpu>;
using Whole = nb::ndarray<const int32_t, nb::c_contig, nb::device::cpu>;
using Keys = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;
using Made = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

template <class T>
nb::ndarray<nb::numpy, T> given(std::vector<T>&& values, std::vector<size_t> shape) {
    auto* kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete (std::vector<T>*)p; });
    return nb::ndarray<nb::numpy, T>(kept->data(), shape.size(), shape.data(), owner);
}

const FuseKernels& named(const std::string& name) {
#if defined(SURFKIT_X86)
    if (name == "avx512") return fuse_kernels_avx512();
    if (name == "avx2") return fuse_kernels_avx2();
#endif
    return fuse_kernels_baseline();
}

Pose pose_of(const std::vector<double>& m) {  // 4 x 4 by rows
    return {{{m.at(0), m.at(1), m.at(2)}, {m.at(4), m.at(5), m.at(6)}, {m.at(8), m.at(9), m.at(10)}},
            {m.at(3), m.at(7), m.at(11)}};
}

Lens lens_of(const Floats& depth, const std::vector<double>& l) {
    return {(int)depth.shape(1), (int)depth.shape(0), (float)l.at(0), (float)l.at(1), (float)l.at(2), (float)l.at(3)};
}

}  // namespace

void add_mesh(nb::module_& m) {
    nb::class_<Grid>(m, "Grid")
        .def("__init__",
             [](Grid* self, double voxel, double reach, std::vector<int64_t> low, std::vector<int64_t> high,
                int64_t most_blocks) { new (self) Grid(voxel, reach, &low.at(0), &high.at(0), most_blocks); })
        .def("fuse",
             [](Grid& self, Floats depth, Floats slant, Words shade, std::vector<double> pose, std::vector<double> lens,
                Floats offsets, std::vector<double> lengths, bool carve, const std::string& kernels, int threads) {
                 FuseJob job;
                 job.depth = depth.data();
                 job.slant = slant.data();
                 job.shade = shade.data();
                 job.lens = lens_of(depth, lens);
                 std::memcpy(job.offsets, offsets.data(), sizeof job.offsets);
                 job.band = {(float)lengths.at(0), (float)lengths.at(1), (float)lengths.at(2)};
                 const Pose p = pose_of(pose);
                 nb::gil_scoped_release free;
                 return self.fuse(job, p, carve, named(kernels), threads);
             })
        .def("surface",
             [](const Grid& self, Table triangles, Whole edges, int least_weight, std::vector<int64_t> end,
                bool with_edges, int threads) {
                 const CubeTable table{triangles.data(), (int)triangles.shape(1), edges.data()};
                 Triangles t;
                 {
                     nb::gil_scoped_release free;
                     t = self.surface(table, least_weight, &end.at(0), with_edges, threads);
                 }
                 const size_t v = t.vertices.size() / 3, f = t.faces.size() / 3, e = t.edges.size();
                 return nb::make_tuple(given(std::move(t.vertices), {v, 3}), given(std::move(t.faces), {f, 3}),
                                       given(std::move(t.colors), {v, 3}), given(std::move(t.edges), {e}));
             })
        .def("contents",
             [](const Grid& self) {
                 std::vector<int64_t> keys;
                 std::vector<uint8_t> raw;
                 for (const int64_t index : self.order()) {
                     keys.push_back((int64_t)self.key(index));
                     const auto* bytes = (const uint8_t*)&self.block(index);
                     raw.insert(raw.end(), bytes, bytes + sizeof(Block));
                 }
                 const size_t count = keys.size();
                 return nb::make_tuple(given(std::move(keys), {count}),
                                       given(std::move(raw), {count, sizeof(Block)}));
             })
        .def("put",
             [](Grid& self, Keys keys, nb::ndarray<const int16_t, nb::c_contig, nb::device::cpu> distance,
                nb::ndarray<const uint16_t, nb::c_contig, nb::device::cpu> weight, Bytes color) {
                 nb::gil_scoped_release free;
                 self.put(keys.data(), (int64_t)keys.shape(0), distance.data(), weight.data(), color.data());
             })
        .def_prop_ro("blocks", &Grid::blocks)
        .def_prop_ro("bytes", &Grid::bytes);

    m.def(
        "shade",
        [](Floats depth, Floats color, std::optional<Floats> normal, std::vector<double> lens, double near,
           double least, nb::ndarray<uint32_t, nb::c_contig, nb::device::cpu> shade, Made slant, const std::string& kernels,
           int threads) {
            ShadeJob job{depth.data(),         color.data(),          normal ? normal->data() : nullptr,
                         (int)depth.shape(1),  (int)depth.shape(0),   (float)lens.at(0),
                         (float)lens.at(1),    (float)lens.at(2),     (float)lens.at(3),
                         (float)near,          (float)least};
            uint32_t* out = shade.data();
            float* slants = slant.data();
            const FuseKernels& k = named(kernels);
            const int rows = 16;
            nb::gil_scoped_release free;
            parallel((job.height + rows - 1) / rows, threads, [&](int64_t piece) {
                for (int row = (int)piece * rows; row < std::min(job.height, (int)(piece + 1) * rows); row++)
                    k.shade(job, row, out + (int64_t)row * job.width, slants + (int64_t)row * job.width);
            });
        },
        nb::arg("depth"), nb::arg("color"), nb::arg("normal").none(), nb::arg("lens"), nb::arg("near"),
        nb::arg("least"), nb::arg("shade"), nb::arg("slant"), nb::arg("kernels"), nb::arg("threads"));
    m.def("collapse", [](Floats vertices, Whole faces, int64_t least, double limit, Bytes fixed, bool flat) {
        const CollapseJob job{vertices.data(), (int64_t)vertices.shape(0), faces.data(), (int64_t)faces.shape(0),
                              fixed.data(),    least,                      flat,         limit};
        Collapsed made;
        {
            nb::gil_scoped_release free;
            made = collapse(job);
        }
        const size_t v = made.vertices.size() / 3, f = made.faces.size() / 3, all = made.into.size();
        return nb::make_tuple(given(std::move(made.vertices), {v, 3}), given(std::move(made.faces), {f, 3}),
                              given(std::move(made.into), {all}));
    });
    m.def("draw_faces", [](Floats vertices, Whole faces, Made depth,
                           nb::ndarray<int32_t, nb::c_contig, nb::device::cpu> face, int threads) {
        FaceJob job{vertices.data(), faces.data(), (int64_t)faces.shape(0), depth.data(), face.data(),
                    (int)depth.shape(1), (int)depth.shape(0)};
        nb::gil_scoped_release free;
        draw_faces(job, threads);
    });
    m.def("compare_depths", [](Floats depth, Floats other, std::vector<double> lens, std::vector<double> way,
                               std::vector<double> eye, double tolerance, Made agreement, Made against, Made looks,
                               int threads) {
        AgreeJob job{depth.data(), other.data(), (int)other.shape(1), (int)other.shape(0)};
        job.lens = lens_of(depth, lens);
        for (int i = 0; i < 3; i++) job.eye[i] = (float)eye.at(i);
        job.tolerance = (float)tolerance;
        job.agreement = agreement.data(), job.against = against.data(), job.looks = looks.data();
        for (int i = 0; i < 12; i++) job.way[i] = way.at(i);
        nb::gil_scoped_release free;
        parallel(job.lens.height, threads, [&](int64_t row) { agree(job, (int)row); });
    });
}

}  // namespace surfkit
