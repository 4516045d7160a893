// Compiled for AVX-512, AVX2 and the baseline with SURFKIT_KERNELS naming the table.
//
// Three steps, each exact within bounds of its rounding errors: (1) half the squared distance between features, less a
// constant of the vector, as a matrix product of which only the least value of each block of codes is kept; (2) float32
// distances to the codes of the blocks that this does not rule out; (3) float64 distances to the codes that these do not.
#include "nearest.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "../../raster/native/simd.h"

#define SURFKIT_PASTE(a, b) a##b
#define SURFKIT_TABLE(name) SURFKIT_PASTE(nearest_kernels_, name)

namespace surfkit {
namespace {

constexpr int kAcross = kLanes == 4 ? 2 : 3;  // vectors of rows in a tile
constexpr int kDown = kLanes == 16 ? 8 : 4;   // codes at a time: kAcross * kDown sums lie in registers
constexpr int kTile = kAcross * kLanes;
constexpr int kPieces = kBlock / kLanes;
constexpr float kUnit = 1.0f / (1 << 24);  // half the distance from 1 to the next float

// As `broadcast`, which adds the number to zero: an instruction that counts here. Subtracting zero needs none.
static inline Floats every(float x) { return x - Floats{}; }

// Features of the rows, in lanes; rows that are missing are zero.
SURFKIT_INLINE void transpose(const NearestJob& job, int64_t first, int count, float* tile) {
    const int features = job.codes.features;
    for (int row = 0; row < count; row++) {
        const float* from = job.features + (first + row) * features;
        for (int j = 0; j < features; j++) tile[j * kTile + row] = from[j];
    }
    for (int row = count; row < kTile; row++)
        for (int j = 0; j < features; j++) tile[j * kTile + row] = 0;
}

// (blocks, kTile) the least score of each block: half the squared norm of a code less its product with the row.
SURFKIT_INLINE void score(const Codes& codes, const float* tile, float* least) {
    for (int block = 0; block < codes.blocks; block++) {
        Floats low[kAcross];
        for (int at = 0; at < kBlock; at += kDown) {
            const float *half = codes.half + (int64_t)block * kBlock + at;
            const float *minus = codes.minus + (int64_t)block * codes.features * kBlock + at;
            Floats sum[kDown][kAcross];
            for (int c = 0; c < kDown; c++)
                for (int a = 0; a < kAcross; a++) sum[c][a] = every(half[c]);
            for (int j = 0; j < codes.features; j++, minus += kBlock) {
                Floats x[kAcross];
                for (int a = 0; a < kAcross; a++) x[a] = load(tile + j * kTile + a * kLanes);
                for (int c = 0; c < kDown; c++) {
                    const Floats w = every(minus[c]);
                    for (int a = 0; a < kAcross; a++) sum[c][a] = madd(x[a], w, sum[c][a]);
                }
            }
            for (int a = 0; a < kAcross; a++) {
                Floats some = sum[0][a];
#pragma GCC unroll 8
                for (int c = 1; c < kDown; c++) some = lower(some, sum[c][a]);
                low[a] = at ? lower(low[a], some) : some;
            }
        }
        for (int a = 0; a < kAcross; a++) store(least + (int64_t)block * kTile + a * kLanes, low[a]);
    }
}

// What is known of the nearest code of one row.
struct Search {
    const NearestJob* job;
    int64_t row;
    const float* vector;
    std::vector<std::pair<float, int32_t>>* close;  // float32 distances and places of codes that may be the nearest
    int32_t without;
    float slack, tiny;  // bounds of the rounding errors of the float32 distances, relative and absolute
    float least, limit; // of the float32 distances, and what is needed to be the nearest after all

    void begin(const NearestJob& j, int64_t r, std::vector<std::pair<float, int32_t>>& c) {
        job = &j, row = r, vector = j.vectors + r * j.codes.dimensions, close = &c;
        without = j.without ? j.without[r] : -1;
        slack = 1 + 2 * (float)(j.codes.dimensions + 8) * kUnit;
        tiny = (float)(j.codes.dimensions + 8) * std::ldexp(1.0f, -125);
        least = limit = std::numeric_limits<float>::infinity();
        close->clear();
    }

    SURFKIT_INLINE void look(int block) {
        const int dimensions = job->codes.dimensions;
        const float* code = job->codes.value + (int64_t)block * dimensions * kBlock;
        Floats even[kPieces] = {}, odd[kPieces] = {};
        int j = 0;
        for (; j + 1 < dimensions; j += 2, code += 2 * kBlock)
            for (int p = 0; p < kPieces; p++) {
                const Floats a = load(code + p * kLanes) - vector[j], b = load(code + kBlock + p * kLanes) - vector[j + 1];
                even[p] = madd(a, a, even[p]);
                odd[p] = madd(b, b, odd[p]);
            }
        for (int p = 0; p < kPieces; p++) {
            if (j < dimensions) {
                const Floats a = load(code + p * kLanes) - vector[j];
                even[p] = madd(a, a, even[p]);
            }
            const Floats sum = even[p] + odd[p];
            uint32_t some = bits(less_equal(sum, limit));
            if (!some) continue;
            alignas(64) float each[kLanes];
            store(each, sum);
            for (; some; some &= some - 1) {
                const int lane = __builtin_ctz(some);
                const int32_t code = job->codes.index[block * kBlock + p * kLanes + lane];
                if (code < 0 || code == without) continue;
                close->push_back({each[lane], block * kBlock + p * kLanes + lane});
                if (each[lane] < least) least = each[lane], limit = least * slack + tiny;
            }
        }
    }

    void finish() {
        const int dimensions = job->codes.dimensions;
        double best = std::numeric_limits<double>::infinity();
        int32_t index = -1;
        for (const auto& [rough, place] : *close) {
            const int32_t code = job->codes.index[place];
            if (rough > limit) continue;
            const float* value = job->codes.value + (int64_t)(place / kBlock) * dimensions * kBlock + place % kBlock;
            double sum = 0;
            for (int j = 0; j < dimensions; j++) {
                const double off = (double)vector[j] - (double)value[j * kBlock];
                sum += off * off;
            }
            if (sum < best || (sum == best && code < index)) best = sum, index = code;
        }
        job->index[row] = index;
        job->distance[row] = (float)best;
    }
};

// Block of the least score of each row.
SURFKIT_INLINE void guess(int blocks, const float* least, int32_t* block) {
    for (int a = 0; a < kAcross; a++) {
        Floats low = load(least + a * kLanes);
        Ints at{};
        for (int b = 1; b < blocks; b++) {
            const Floats here = load(least + (int64_t)b * kTile + a * kLanes);
            const Mask better = lesser(here, low);
            low = select(better, here, low);
            at = select(better, Ints{} + b, at);
        }
        std::memcpy(block + a * kLanes, &at, sizeof at);
    }
}

// Look at the blocks whose least score leaves room for a code nearer than what is known.
SURFKIT_INLINE void sweep(const Codes& codes, const float* tile, const float* least, const int32_t* guessed, int across, int count,
                          Search* searches) {
    const float off = 0.5f * (float)(codes.features + 16) * kUnit;
    Floats square{};
    for (int j = 0; j < codes.features; j++) {
        const Floats x = load(tile + j * kTile + across);
        square = madd(x, x, square);
    }
    const Floats norm = root(square);
    alignas(64) float base[kLanes], room[kLanes];  // squared norms; half of what the limits leave of them
    store(base, square);
    const auto leave = [&](int lane) { room[lane] = 0.5f * (searches[across + lane].limit - base[lane]); };
    for (int lane = 0; lane < kLanes; lane++) {
        room[lane] = -std::numeric_limits<float>::infinity();
        if (across + lane < count) leave(lane);
    }
    for (int block = 0; block < codes.blocks; block++) {
        const Floats reach = norm + codes.radius[block];
        const Floats limit = madd(reach * reach, off, load(room));
        uint32_t open = bits(less_equal(load(least + (int64_t)block * kTile + across), limit));
        for (; open; open &= open - 1) {
            const int lane = __builtin_ctz(open);
            if (guessed[across + lane] == block) continue;
            searches[across + lane].look(block);
            leave(lane);
        }
    }
}

void nearest(const NearestJob& job, int64_t first, NearestScratch& scratch) {
    const Codes& codes = job.codes;
    const int count = (int)std::min<int64_t>(kTile, job.rows - first);
    scratch.tile.resize((size_t)codes.features * kTile);
    scratch.least.resize((size_t)codes.blocks * kTile);
    scratch.close.resize(kTile);
    float *tile = scratch.tile.data(), *least = scratch.least.data();
    transpose(job, first, count, tile);
    score(codes, tile, least);
    int32_t guessed[kTile];
    guess(codes.blocks, least, guessed);
    Search searches[kTile];
    for (int row = 0; row < count; row++) {
        searches[row].begin(job, first + row, scratch.close[row]);
        searches[row].look(guessed[row]);
    }
    for (int across = 0; across < count; across += kLanes) sweep(codes, tile, least, guessed, across, count, searches);
    for (int row = 0; row < count; row++) searches[row].finish();
}

}  // namespace

const NearestKernels& SURFKIT_TABLE(SURFKIT_KERNELS)() {
    static const NearestKernels table{kTile, nearest};
    return table;
}

}  // namespace surfkit
