// A sparse grid of signed distances: blocks of 8 x 8 x 8 voxels on one lattice, made where surfaces are seen.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "fuse.h"

namespace surfkit {

struct Triangles {
    std::vector<float> vertices;   // 3 each
    std::vector<uint8_t> colors;   // 3 each
    std::vector<int64_t> edges;    // the lattice edge of each vertex: the same in every tile
    std::vector<int32_t> faces;    // 3 each
};

// What marching cubes needs, made in surfkit/mesh/cubes.py.
struct CubeTable {
    const int8_t* triangles;  // (256, width)
    int width;
    const int32_t* edges;  // (12, 4) start and axis
};

struct Pose {
    double turn[3][3], shift[3];  // world to camera
};

class Grid {
  public:
    // Blocks from `low` up to, without, `high` are made; all lengths in units of the world.
    Grid(double voxel, double reach, const int64_t low[3], const int64_t high[3], int64_t most_blocks);
    Grid(const Grid&) = delete;

    // Make the blocks that a view needs and fuse it into them, or with `carve` into all that it sees. False, and
    // nothing is done, if there would be more than `most_blocks`.
    bool fuse(const FuseJob& job, const Pose& pose, bool carve, const FuseKernels& kernels, int threads);

    // Take blocks that were fused elsewhere, none of which is here: their keys, and the voxels of each in turn.
    void put(const int64_t* keys, int64_t count, const int16_t* distance, const uint16_t* weight, const uint8_t* color);

    // The surface where the weight of all voxels around is at least `least_weight`; of cells below `end` alone.
    Triangles surface(const CubeTable& table, int least_weight, const int64_t end[3], bool with_edges,
                      int threads) const;

    int64_t blocks() const { return (int64_t)keys_.size(); }
    int64_t bytes() const;

    // Coordinates and contents of all blocks, in the order of their coordinates; for tests.
    std::vector<int64_t> order() const;
    uint64_t key(int64_t index) const { return keys_[index]; }
    const Block& block(int64_t index) const { return chunks_[index / kChunk][index % kChunk]; }

  private:
    struct Free {
        void operator()(Block* p) const;
    };
    static constexpr int64_t kChunk = 256;

    Block& block(int64_t index) { return chunks_[index / kChunk][index % kChunk]; }
    int64_t find(uint64_t key) const;
    void insert(uint64_t key);
    void rehash(size_t size);
    std::vector<uint64_t> seen_by(const FuseJob& job, const Pose& pose, const FuseKernels& kernels, int threads) const;
    std::vector<int64_t> in_sight(const FuseJob& job, const Pose& pose, int threads) const;

    double voxel_, reach_;
    int64_t low_[3], high_[3], most_blocks_;
    std::vector<uint64_t> keys_;
    std::vector<int32_t> slots_;  // open addressing: index of a block + 1, or 0
    std::vector<std::unique_ptr<Block[], Free>> chunks_;
};

}  // namespace surfkit
