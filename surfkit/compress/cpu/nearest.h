// The nearest of many codes to each of many vectors, exactly.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

namespace surfkit {

constexpr int kBlock = 16;  // codes that are looked at together

// A codebook, packed. Features are fewer numbers than dimensions, such that the distance between the features of two
// vectors is at most that between the vectors: blocks of codes are skipped by them.
struct Codes {
    int dimensions, features, blocks;
    const float* value;   // (blocks, dimensions, kBlock) the codes themselves
    const int32_t* index; // (blocks, kBlock) which code it is; -1 fills the last block
    const float* minus;   // (blocks, features, kBlock) the negative of the features
    const float* half;    // (blocks, kBlock) half the squared norm of the features
    const float* radius;  // (blocks) greatest norm of the features of a block
};

struct NearestJob {
    Codes codes;
    const float* vectors;   // (rows, dimensions)
    const float* features;  // (rows, features)
    const int32_t* without; // (rows) a code of each row that does not count, or null
    int64_t rows;
    int32_t* index;   // (rows) out
    float* distance;  // (rows) out, squared; infinite, and -1 the index, where no code counts
};

// Memory of one thread.
struct NearestScratch {
    std::vector<float> tile, least;
    std::vector<std::vector<std::pair<float, int32_t>>> close;
};

struct NearestKernels {
    int rows;  // that are worked on together
    // Rows from first on, as many as that at most. The squared distance is a sum of float64 in the order of the
    // dimensions, and equal ones go to the lowest index: no compilation changes a bit.
    void (*nearest)(const NearestJob& job, int64_t first, NearestScratch& scratch);
};

const NearestKernels& nearest_kernels_baseline();
#if defined(SURFKIT_X86)
const NearestKernels& nearest_kernels_avx2();
const NearestKernels& nearest_kernels_avx512();
#endif

}  // namespace surfkit
