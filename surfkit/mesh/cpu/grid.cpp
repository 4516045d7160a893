#include "grid.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <new>

#include "../../raster/cpu/pool.h"

namespace surfkit {
namespace {

constexpr int kCoarse = 16;  // pixels of a tile of the coarse depth
constexpr int kRows = 16;    // of the picture in one piece of work

uint64_t pack(int64_t x, int64_t y, int64_t z) {
    return (uint64_t)(z + kBlockBias) << 2 * kBlockBits | (uint64_t)(y + kBlockBias) << kBlockBits |
           (uint64_t)(x + kBlockBias);
}

int64_t part(uint64_t key, int axis) {
    return (int64_t)(key >> axis * kBlockBits & ((1u << kBlockBits) - 1)) - kBlockBias;
}

uint64_t mixed(uint64_t x) {
    x ^= x >> 31;
    x *= 0x7fb5d329728ea185ull;
    x ^= x >> 27;
    x *= 0x81dadef4bc2dd44dull;
    return x ^ x >> 33;
}

// The largest depth in each tile of kCoarse x kCoarse pixels, and those next to it, which interpolation may reach.
struct Coarse {
    int wide, high;
    std::vector<float> most;

    Coarse(const FuseJob& job, int threads)
        : wide((job.width + kCoarse - 1) / kCoarse), high((job.height + kCoarse - 1) / kCoarse), most(wide * high) {
        parallel(high, threads, [&](int64_t row) {
            const int y0 = std::max((int)row * kCoarse - 1, 0), y1 = std::min((int)(row + 1) * kCoarse + 1, job.height);
            for (int col = 0; col < wide; col++) {
                const int x0 = std::max(col * kCoarse - 1, 0), x1 = std::min((col + 1) * kCoarse + 1, job.width);
                float top = 0;
                for (int y = y0; y < y1; y++)
                    for (int x = x0; x < x1; x++) top = std::max(top, job.depth[(int64_t)y * job.width + x]);
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
            const double focal[2] = {job.fx, job.fy}, centre[2] = {job.cx, job.cy};
            const int size[2] = {job.width, job.height};
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
std::vector<uint64_t> Grid::seen_by(const FuseJob& job, const Pose& pose, int threads) const {
    const int pieces = (job.height + kRows - 1) / kRows;
    std::vector<std::vector<uint64_t>> found(pieces);
    const double per_block = 1 / (voxel_ * kSide), reach = reach_ * per_block;
    const auto& r = pose.turn;
    double eye[3];
    for (int axis = 0; axis < 3; axis++)
        eye[axis] = -(r[0][axis] * pose.shift[0] + r[1][axis] * pose.shift[1] + r[2][axis] * pose.shift[2]) * per_block;
    parallel(pieces, threads, [&](int64_t piece) {
        struct Span {
            uint64_t low, high;
        };
        std::vector<Span> above(job.width, Span{~0ull, ~0ull});
        std::vector<uint64_t>& keys = found[piece];
        const int end = std::min(job.height, (int)(piece + 1) * kRows);
        for (int y = (int)piece * kRows; y < end; y++) {
            Span left{~0ull, ~0ull};
            const float* depth = job.depth + (int64_t)y * job.width;
            const uint32_t* shade = job.shade + (int64_t)y * job.width;
            for (int x = 0; x < job.width; x++) {
                const double d = depth[x];
                if (!(d > 0) || !(shade[x] >> 24)) continue;
                const double u = (x + 0.5 - job.cx) / job.fx * d * per_block;
                const double v = (y + 0.5 - job.cy) / job.fy * d * per_block, w = d * per_block;
                int64_t low[3], high[3];
                bool there = true;
                for (int axis = 0; axis < 3; axis++) {
                    const double at = r[0][axis] * u + r[1][axis] * v + r[2][axis] * w + eye[axis];
                    low[axis] = std::max((int64_t)std::floor(at - reach), low_[axis]);
                    high[axis] = std::min((int64_t)std::floor(at + reach), high_[axis] - 1);
                    there &= low[axis] <= high[axis];
                }
                if (!there) continue;
                const Span here{pack(low[0], low[1], low[2]), pack(high[0], high[1], high[2])};
                const bool known = (here.low == left.low && here.high == left.high) ||
                                   (here.low == above[x].low && here.high == above[x].high);
                left = above[x] = here;
                if (known) continue;
                for (int64_t k = low[2]; k <= high[2]; k++)
                    for (int64_t j = low[1]; j <= high[1]; j++)
                        for (int64_t i = low[0]; i <= high[0]; i++) keys.push_back(pack(i, j, k));
            }
        }
    });
    std::vector<uint64_t> all;
    for (const auto& keys : found) all.insert(all.end(), keys.begin(), keys.end());
    return all;
}

// Blocks that the view may see, and that are not wholly behind what it sees.
std::vector<int64_t> Grid::in_sight(const FuseJob& job, const Pose& pose) const {
    const Coarse coarse(job, 1);
    const double side = voxel_ * kSide, radius = side * 0.8661, middle = (kSide - 1) * 0.5 * voxel_;
    std::vector<int64_t> found;
    for (size_t index = 0; index < keys_.size(); index++) {
        double world[3], at[3];
        for (int axis = 0; axis < 3; axis++) world[axis] = part(keys_[index], axis) * side + middle;
        for (int row = 0; row < 3; row++) {
            const double* r = pose.turn[row];
            at[row] = r[0] * world[0] + r[1] * world[1] + r[2] * world[2] + pose.shift[row];
        }
        if (at[2] - radius < coarse.under(job, at, radius) + job.truncation && at[2] + radius > 0 &&
            coarse.under(job, at, radius) > 0)
            found.push_back((int64_t)index);
    }
    return found;
}

bool Grid::fuse(const FuseJob& job, const Pose& pose, bool carve, FuseBlock kernel, int threads) {
    std::vector<int64_t> touched;
    std::vector<uint64_t> fresh;
    for (const uint64_t key : seen_by(job, pose, threads)) {
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
    if (carve) touched = in_sight(job, pose);
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
            kernel(job, first, (uint32_t)mixed(key), block(touched[i]));
        }
    });
    return true;
}

std::vector<int64_t> Grid::order() const {
    std::vector<int64_t> order(keys_.size());
    for (size_t i = 0; i < order.size(); i++) order[i] = (int64_t)i;
    std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return keys_[a] < keys_[b]; });
    return order;
}

}  // namespace surfkit
