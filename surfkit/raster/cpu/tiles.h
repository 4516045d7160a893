// The tiles of an image, for the per-pixel kernels.
//
// A tile of 16 x 16 pixels is cut into blocks of 4 x (lanes / 4), one vector each. For each splat the rows of its
// footprint tell which blocks it can touch; blocks whose rays have all ended are left out.
#pragma once

namespace surfkit {
namespace {

constexpr int kBlockRows = kLanes / 4;  // pixel rows in a block
constexpr int kBlocksDown = kTile / kBlockRows;
constexpr int kBlocks = 4 * kBlocksDown;
constexpr float kMiddle = (kTile - 1) / 2.0f;
constexpr uint64_t kRowBits = 0x0001000100010001ull * (kBlockRows == 4 ? 0x1111 : kBlockRows == 2 ? 0x5555 : 0xffff);

// Pixel centres of a block about the tile's centre, where they are smallest and so most exact in a product.
struct Lanes {
    Floats x[kBlocks], y[kBlocks];
    Floats count[kTile / kLanes];
    Lanes() {
        for (int b = 0; b < kBlocks; b++)
            for (int l = 0; l < kLanes; l++) {
                x[b][l] = (float)(b / kBlocksDown * 4 + l % 4) - kMiddle;
                y[b][l] = (float)(b % kBlocksDown * kBlockRows + l / 4) - kMiddle;
            }
        for (int i = 0; i < kTile; i++) count[i / kLanes][i % kLanes] = (float)i - kMiddle;
    }
};
const Lanes& lanes() {
    static const Lanes table;
    return table;
}

// One tile of an image: where its blocks lie in memory.
struct Tile {
    const Job& job;
    int x0, y0;
    float ox, oy;  // the centre
    size_t plane;
    int64_t begin, end;

    Tile(const Job& j, int64_t index)
        : job(j),
          x0((int)(index % j.tiles_x) * kTile),
          y0((int)(index / j.tiles_x) * kTile),
          ox(x0 + kTile / 2.0f),
          oy(y0 + kTile / 2.0f),
          plane((size_t)j.width * j.height),
          begin(j.offsets[index]),
          end(j.offsets[index + 1]) {}

    template <class T>
    void read(const T* from, int block, T* to) const {
        each_row(block, [&](size_t at, int lane, int n) { std::memcpy(to + lane, from + at, n * sizeof(T)); });
    }
    template <class T>
    void write(T* to, int block, const T* from) const {
        each_row(block, [&](size_t at, int lane, int n) { std::memcpy(to + at, from + lane, n * sizeof(T)); });
    }
    Floats read(const float* from, int block) const {
        Floats v{};
        if (from) read(from, block, (float*)&v);
        return v;
    }
    // The blocks with a pixel inside the image, as bits of `touched_blocks`.
    uint64_t inside() const {
        const int rows = job.height - y0 < kTile ? job.height - y0 : kTile;
        uint64_t in = 0;
        for (int j = 0; j < 4; j++)
            if (x0 + 4 * j < job.width) in |= ((1ull << rows) - 1) << (16 * j);
        return in & kRowBits;
    }
    Mask inside(int block) const {
        int32_t on[kLanes] = {};
        each_row(block, [&](size_t, int lane, int n) {
            for (int i = 0; i < n; i++) on[lane + i] = 1;
        });
        Ints v;
        std::memcpy(&v, on, sizeof v);
        return equal(v, Ints{} + 1);
    }

  private:
    template <class F>
    SURFKIT_INLINE void each_row(int block, F f) const {
        const int x = x0 + block / kBlocksDown * 4, y = y0 + block % kBlocksDown * kBlockRows;
        const int n = job.width - x < 4 ? job.width - x : 4;
        if (n == 4 && y + kBlockRows <= job.height) {
            for (int r = 0; r < kBlockRows; r++) f((size_t)(y + r) * job.width + x, 4 * r, 4);
            return;
        }
        if (n <= 0) return;
        for (int r = 0; r < kBlockRows && y + r < job.height; r++) f((size_t)(y + r) * job.width + x, 4 * r, n);
    }
};

// The blocks a record's footprint touches, bit 16 * column + row of pixels. (sx, sy): the tile's centre less the
// anchor.
template <class Record>
SURFKIT_INLINE uint64_t touched_blocks(const Record& s, float sx, float sy) {
    const Lanes& grid = lanes();
    const Floats far = broadcast(1e30f), tiny = broadcast(1e-20f);
    const float more = 1.0005f;  // the roots are rough
    uint64_t hit = 0;
    for (int v = 0; v < kTile / kLanes; v++) {
        const Floats y = grid.count[v] + sy;
        const Floats dy = y - s.my, left = madd(dy * dy, -s.flat, broadcast(1.0f));
        const Floats half = rough_root(higher(left * (s.wide * more), tiny)),
                     mid = madd(dy, s.tilt, broadcast(s.mx - sx));
        const Mask on = less_equal(0.0f, left);
        Floats low = select(on, mid - half, far), high = select(on, mid + half, -far);
        if (s.disc_r2 > 0) {
            const Floats dd = y - s.disc_y, rest = s.disc_r2 - dd * dd;
            const Floats reach = rough_root(higher(rest * more, tiny));
            const Mask disc = less_equal(0.0f, rest);
            low = lower(low, select(disc, (s.disc_x - sx) - reach, far));
            high = higher(high, select(disc, (s.disc_x - sx) + reach, -far));
        }
        for (int j = 0; j < 4; j++)
            hit |= (uint64_t)bits(less_equal(low, 4.0f * j + 3 - kMiddle) & less_equal(4.0f * j - kMiddle, high))
                   << (16 * j + v * kLanes);
    }
    if (kBlockRows > 1) hit |= hit >> 1;
    if (kBlockRows > 2) hit |= hit >> 2;
    return hit & kRowBits;
}
inline int block_at(int bit) { return bit / 16 * kBlocksDown + bit % 16 / kBlockRows; }

// Fetches into the cache what the entry `ahead` of k will need: records lie in the order of the splats, not of the
// tile.
template <class K, int ahead>
SURFKIT_INLINE void fetch(const Tile& tile, int64_t k) {
    const int64_t next = k + ahead;
    if (next < tile.begin || next >= tile.end) return;
    const char* at = (const char*)((const typename K::Record*)tile.job.records + tile.job.entries[next].record);
    for (size_t line = 0; line < sizeof(typename K::Record); line += 64) __builtin_prefetch(at + line);
}
template <class K>
inline const typename K::Record& record_of(const Tile& tile, int64_t k) {
    return ((const typename K::Record*)tile.job.records)[tile.job.entries[k].record];
}

}  // namespace
}  // namespace surfkit
