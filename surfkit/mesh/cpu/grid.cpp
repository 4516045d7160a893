#include "grid.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <new>

#include "../../raster/native/pool.h"

namespace surfkit {
namespace {

constexpr int kCoarse = 16;  // pixels of a tile of the coarse depth
constexpr int kRows = 16;    // of the picture in one piece of work

// The largest depth in each tile of kCoarse x kCoarse pixels, and those next to it, which interpolation may reach.
struct Coarse {
    int wide, high;
    std::vector<float> most;

    Coarse(const FuseJob& job, int threads)
        : wide((job.lens.width + kCoarse - 1) / kCoarse), high((job.lens.height + kCoarse - 1) / kCoarse), most(wide * high) {
        parallel(high, threads, [&](int64_t row) {
            const int y0 = std::max((int)row * kCoarse - 1, 0), y1 = std::min((int)(row + 1) * kCoarse + 1, job.lens.height);
            for (int col = 0; col < wide; col++) {
                const int x0 = std::max(col * kCoarse - 1, 0), x1 = std::min((col + 1) * kCoarse + 1, job.lens.width);
                float top = 0;
                for (int y = y0; y < y1; y++)
                    for (int x = x0; x < x1; x++) top = std::max(top, job.depth[(int64_t)y * job.lens.width + x]);
                most[row * wide + col] = top;
            }
        });
    }

    // The largest depth that a ball may fall on; 0 if it is out of the picture.
    float under(const FuseJob& job, const double at[3], double radius) const {
        const double near = at[2] - radius;
        if (at[2] + radius <= 0) return 0;
        int low[2] = {0, 0}, high_[2] = {wide - 1, high - 1};
        if (near > 0.1 * radius) {  // else it surrounds the camera, or nearly so
            const double focal[2] = {job.lens.fx, job.lens.fy}, centre[2] = {job.lens.cx, job.lens.cy};
            const int size[2] = {job.lens.width, job.lens.height};
            for (int axis = 0; axis < 2; axis++) {
                const double a = at[axis] - radius, b = at[axis] + radius, far = at[2] + radius;
                const double from = focal[axis] * (a < 0 ? a / near : a / far) + centre[axis] - 1;
                const double to = focal[axis] * (b < 0 ? b / far : b / near) + centre[axis] + 1;
                if (to < 0 || from > size[axis]) return 0;
                low[axis] = (int)std::max(from, 0.0) / kCoarse;
                high_[axis] = (int)std::min(to, size[axis] - 1.0) / kCoarse;
                low[axis] = std::min(low[axis], high_[axis]);
            }
        }
        float top = 0;
        for (int y = low[1]; y <= high_[1]; y++)
            for (int x = low[0]; x <= high_[0]; x++) top = std::max(top, most[y * wide + x]);
        return top;
    }
};

}  // namespace

void Grid::Free::operator()(Block* p) const { std::free(p); }

Grid::Grid(double voxel, double reach, const int64_t low[3], const int64_t high[3], int64_t most_blocks)
    : voxel_(voxel), reach_(reach), most_blocks_(most_blocks) {
    std::copy(low, low + 3, low_);
    std::copy(high, high + 3, high_);
    rehash(1 << 12);
}

int64_t Grid::bytes() const {
    return (int64_t)(chunks_.size() * kChunk * sizeof(Block) + keys_.capacity() * sizeof(uint64_t) +
                     slots_.capacity() * sizeof(int32_t));
}

int64_t Grid::find(uint64_t key) const {
    const size_t mask = slots_.size() - 1;
    for (size_t at = mixed(key) & mask;; at = (at + 1) & mask) {
        if (!slots_[at]) return -1;
        if (keys_[slots_[at] - 1] == key) return slots_[at] - 1;
    }
}

void Grid::rehash(size_t size) {
    slots_.assign(size, 0);
    for (size_t i = 0; i < keys_.size(); i++) {
        size_t at = mixed(keys_[i]) & (size - 1);
        while (slots_[at]) at = (at + 1) & (size - 1);
        slots_[at] = (int32_t)i + 1;
    }
}

void Grid::insert(uint64_t key) {
    if (2 * (keys_.size() + 1) > slots_.size()) rehash(2 * slots_.size());
    if (keys_.size() == chunks_.size() * kChunk) {
        void* const p = std::aligned_alloc(alignof(Block), kChunk * sizeof(Block));
        if (!p) throw std::bad_alloc();
        std::memset(p, 0, kChunk * sizeof(Block));
        chunks_.emplace_back((Block*)p);
    }
    keys_.push_back(key);
    size_t at = mixed(key) & (slots_.size() - 1);
    while (slots_[at]) at = (at + 1) & (slots_.size() - 1);
    slots_[at] = (int32_t)keys_.size();
}

// Keys of the blocks within reach of what the pixels show, some of them several times.
std::vector<uint64_t> Grid::seen_by(const FuseJob& job, const Pose& pose, const FuseKernels& kernels,
                                    int threads) const {
    RowJob all{};
    all.width = job.lens.width;
    all.fx = job.lens.fx;
    all.cx = job.lens.cx;
    all.per_block = 1 / (voxel_ * kSide);
    all.reach = reach_ * all.per_block;
    for (int axis = 0; axis < 3; axis++) {
        for (int row = 0; row < 3; row++) {
            all.turn[axis][row] = pose.turn[row][axis];
            all.eye[axis] -= pose.turn[row][axis] * pose.shift[row] * all.per_block;
        }
        all.low[axis] = (int32_t)low_[axis];
        all.high[axis] = (int32_t)high_[axis] - 1;
    }
    const int pieces = (job.lens.height + kRows - 1) / kRows;
    std::vector<std::vector<uint64_t>> found(pieces);
    parallel(pieces, threads, [&](int64_t piece) {
        const size_t width = (size_t)job.lens.width;
        std::vector<uint64_t> low(2 * width, kNoKey), high(2 * width, kNoKey);  // this row and the one above, in turns
        std::vector<uint64_t>& keys = found[piece];
        RowJob row = all;
        const int end = std::min(job.lens.height, (int)(piece + 1) * kRows);
        for (int y = (int)piece * kRows; y < end; y++) {
            row.depth = job.depth + (int64_t)y * job.lens.width;
            row.shade = job.shade + (int64_t)y * job.lens.width;
            row.row = (y + 0.5 - job.lens.cy) / job.lens.fy;
            const size_t here = y % 2 * width, above = (y + 1) % 2 * width;
            kernels.row(row, &low[here], &high[here]);
            uint64_t left_low = kNoKey, left_high = kNoKey;
            for (size_t x = 0; x < width; x++) {
                const uint64_t a = low[here + x], b = high[here + x];
                const bool known = (a == left_low && b == left_high) || (a == low[above + x] && b == high[above + x]);
                left_low = a, left_high = b;
                if (known || a == kNoKey) continue;
                for (int64_t k = part(a, 2); k <= part(b, 2); k++)
                    for (int64_t j = part(a, 1); j <= part(b, 1); j++)
                        for (int64_t i = part(a, 0); i <= part(b, 0); i++) keys.push_back(packed((int)i, (int)j, (int)k));
            }
        }
    });
    std::vector<uint64_t> joined;
    for (const auto& keys : found) joined.insert(joined.end(), keys.begin(), keys.end());
    return joined;
}

// Blocks that the view may see, and that are not wholly behind what it sees.
std::vector<int64_t> Grid::in_sight(const FuseJob& job, const Pose& pose, int threads) const {
    const Coarse coarse(job, threads);
    const double side = voxel_ * kSide, radius = side * 0.8661, middle = (kSide - 1) * 0.5 * voxel_;
    const int64_t piece = 1024, count = blocks();
    std::vector<std::vector<int64_t>> found((count + piece - 1) / piece);
    parallel((int64_t)found.size(), threads, [&](int64_t at_piece) {
        for (int64_t index = at_piece * piece; index < std::min(count, (at_piece + 1) * piece); index++) {
            double world[3], at[3];
            for (int axis = 0; axis < 3; axis++) world[axis] = part(keys_[index], axis) * side + middle;
            for (int row = 0; row < 3; row++) {
                const double* r = pose.turn[row];
                at[row] = r[0] * world[0] + r[1] * world[1] + r[2] * world[2] + pose.shift[row];
            }
            const float most = coarse.under(job, at, radius);
            if (most > 0 && at[2] - radius < most + job.band.truncation / kLeastSlant) found[at_piece].push_back(index);
        }
    });
    std::vector<int64_t> joined;
    for (const auto& some : found) joined.insert(joined.end(), some.begin(), some.end());
    return joined;
}

bool Grid::fuse(const FuseJob& job, const Pose& pose, bool carve, const FuseKernels& kernels, int threads) {
    std::vector<int64_t> touched;
    std::vector<uint64_t> fresh;
    for (const uint64_t key : seen_by(job, pose, kernels, threads)) {
        const int64_t index = find(key);
        if (index < 0)
            fresh.push_back(key);
        else if (!carve)
            touched.push_back(index);
    }
    std::sort(fresh.begin(), fresh.end());
    fresh.erase(std::unique(fresh.begin(), fresh.end()), fresh.end());
    if (blocks() + (int64_t)fresh.size() > most_blocks_) return false;
    for (const uint64_t key : fresh) {
        if (!carve) touched.push_back(blocks());
        insert(key);
    }
    if (carve) touched = in_sight(job, pose, threads);
    std::sort(touched.begin(), touched.end());
    touched.erase(std::unique(touched.begin(), touched.end()), touched.end());
    const int64_t piece = 16, count = (int64_t)touched.size();
    parallel((count + piece - 1) / piece, threads, [&](int64_t at) {
        for (int64_t i = at * piece; i < std::min(count, (at + 1) * piece); i++) {
            const uint64_t key = keys_[touched[i]];
            float first[3];
            for (int row = 0; row < 3; row++) {
                const double* r = pose.turn[row];
                const double side = voxel_ * kSide;
                first[row] = (float)(r[0] * (part(key, 0) * side) + r[1] * (part(key, 1) * side) +
                                     r[2] * (part(key, 2) * side) + pose.shift[row]);
            }
            kernels.block(job, first, (uint32_t)mixed(key), block(touched[i]));
        }
    });
    return true;
}

void Grid::put(const int64_t* keys, int64_t count, const int16_t* distance, const uint16_t* weight,
               const uint8_t* color) {
    for (int64_t i = 0; i < count; i++) {
        insert((uint64_t)keys[i]);
        Block& made = block(blocks() - 1);
        std::memcpy(made.distance, distance + i * kVoxels, sizeof made.distance);
        std::memcpy(made.weight, weight + i * kVoxels, sizeof made.weight);
        std::memcpy(made.color, color + i * 3 * kVoxels, sizeof made.color);
    }
}

std::vector<int64_t> Grid::order() const {
    std::vector<int64_t> order(keys_.size());
    for (size_t i = 0; i < order.size(); i++) order[i] = (int64_t)i;
    std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return keys_[a] < keys_[b]; });
    return order;
}

}  // namespace surfkit
