// What the depth maps of a view say of places in space: see mesh/visibility.py.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "grid.h"

namespace surfkit {

// What a view sees, in one or more depth maps.
struct Sight {
    const float* depth;    // (maps, lens.height, lens.width) camera z; 0 for none
    const float* weight;   // of each of them; 0 does not count
    const float* normal;   // (3, height, width) of the surface, camera axes; any length
    const uint8_t* color;  // (3, height, width)
    int maps;
    Lens lens;
    Pose pose;  // world to camera
};

// Means of pixels in the cells of a lattice.
struct Cells {
    double side;
    int64_t low[3], high[3];  // cells along each axis that count: from low up to, without, high
    int64_t rows = 0;
    std::vector<int64_t> keys;   // of each row
    std::vector<double> sums;    // (rows, 10) weight; weight times position less that of the cell, normal and colour
    std::vector<int64_t> table;  // rows by hashes of keys, -1 for none

    void add(const Sight& sight, double limit);
};

// Three numbers of `CELL_BITS` bits, of cells counted from -2^(CELL_BITS - 1).
constexpr int CELL_BITS = 21;
int64_t cell_key(const int64_t at[3]);

struct VoteJob {
    const float* places;  // (count, 3)
    float noise;          // standard deviation of a depth, as a share of it
    float thickness;      // how far behind a depth it votes for full, in standard deviations
    float *empty, *full;  // (count) to be added to
};

void vote(const VoteJob& job, const Sight& sight, int64_t from, int64_t to);

// Whether a view may see some of a box, given by its lowest and its highest corner.
bool may_see(const Sight& sight, const float* low, const float* high);

struct ConfirmJob {
    const float* places;   // (count, 3) on a surface
    const float* normals;  // (count, 3) out of it, of length 1
    float tolerance;       // distance along the normal
    float* views;          // (count) to be added to: 1 for a view with such a depth
};

void confirm(const ConfirmJob& job, const Sight& sight, int64_t from, int64_t to);

struct PullJob {
    const float* places;   // (count, 3) on a surface
    const float* normals;  // (count, 3) out of it, of length 1
    float reach;           // distance along the normal within which a depth counts
    float near;            // depth up to which a pixel counts fully
    float *sum, *weight, *square, *views;  // (count) to be added to; 1 for a view whose depth counts
};

void pull(const PullJob& job, const Sight& sight, int64_t from, int64_t to);

// The tetrahedron that holds a place, by a walk from another one; -1 outside.
struct Walk {
    const double* points;       // (P, 3)
    const int32_t* corners;     // (T, 4)
    const int32_t* neighbours;  // (T, 4)
};

int32_t locate(const Walk& walk, const double* place, int32_t start);

double volume(const Walk& walk, int64_t tet);

// What a face between an empty and a full tetrahedron costs, in areas of a cell times `UNITS`.
struct CostJob {
    const float* normals;  // (P - 4, 3) of the points, length 1 or 0; the last four points enclose all: a face with one
                           // of them costs as much as a cell wide strip along its edge, one with more nothing
    const float* evidence;  // (T) sum of the votes on a tetrahedron
    int64_t count;          // of points with normals
    double side;            // of a cell
    float aligned;          // share of the cost of a face that lies as the normals of its corners say
    float sure, certain;    // share of the cost where votes are without end; their sum at which half of the way is left
    int32_t* cost;          // (T, 4) to be written
};

constexpr double UNITS = 1000;

void price(const CostJob& job, const Walk& walk, int64_t tet);

}  // namespace surfkit
