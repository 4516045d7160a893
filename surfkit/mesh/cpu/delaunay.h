// The Delaunay tetrahedralisation of points: see mesh/delaunay.py.
#pragma once

#include <cstdint>
#include <vector>

namespace surfkit {

struct Tetrahedra {
    std::vector<int32_t> corners;     // (T, 4) rows of points, positively oriented; the last four points enclose all
    std::vector<int32_t> neighbours;  // (T, 4) the one opposite to each corner; -1 where there is none
    std::vector<double> enclosing;    // (4, 3)
    int64_t left_out = 0;             // points in the place of another one
};

// The least step of the grid for points (count, 3): about a millionth of their extent.
double least_step(const double* points, int64_t count);

// Points (count, 3), of which those that fall on the same place of a grid are one: it has whole multiples of `step`, so
// that parts of a set are rounded as the whole is.
Tetrahedra tetrahedralise(const double* points, int64_t count, double step);

}  // namespace surfkit
