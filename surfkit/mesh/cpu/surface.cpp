// Marching cubes over the blocks of a grid.
#include <algorithm>
#include <cstring>

#include "../../raster/native/pool.h"
#include "grid.h"

namespace surfkit {
namespace {

constexpr int kWide = kSide + 1;
constexpr int kWords = kVoxels / 64;

uint64_t neighbour(uint64_t key, int dx, int dy, int dz) {
    return key + (uint64_t)dx + ((uint64_t)dy << kBlockBits) + ((uint64_t)dz << 2 * kBlockBits);
}

// Which edges from the voxels of a block upwards the surface crosses, and how many come before each word of bits.
struct Crossings {
    uint64_t bits[3][kWords];
    int32_t before[3][kWords];
    int64_t first;  // vertex

    bool crosses(int axis, int voxel) const { return bits[axis][voxel / 64] >> (voxel % 64) & 1; }
    int64_t vertex(int axis, int voxel) const {
        const uint64_t lower = bits[axis][voxel / 64] & ((uint64_t{1} << (voxel % 64)) - 1);
        return first + before[axis][voxel / 64] + __builtin_popcountll(lower);
    }
};

// The distances of a block and of the next voxel on each axis; 0 where there is none, and never 0 where there is one.
struct Corners {
    int16_t distance[kWide][kWide][kWide];  // z, y, x
    const Block* blocks[2][2][2];

    bool fill(const Grid& grid, const int64_t near[8], int least_weight) {
        bool some = false;
        for (int n = 0; n < 8; n++)
            blocks[n >> 2][n >> 1 & 1][n & 1] = near[n] < 0 ? nullptr : &grid.block(near[n]);
        for (int z = 0; z < kWide; z++)
            for (int y = 0; y < kWide; y++)
                for (int x = 0; x < kWide; x++) {
                    const Block* b = blocks[z / kSide][y / kSide][x / kSide];
                    const int at = (z % kSide * kSide + y % kSide) * kSide + x % kSide;
                    const int d = b && b->weight[at] >= least_weight ? b->distance[at] : 0;
                    const bool seen = b && b->weight[at] >= least_weight;
                    distance[z][y][x] = (int16_t)(seen && !d ? 1 : d);
                    some |= d < 0;
                }
        return some;
    }
};

}  // namespace

Triangles Grid::surface(const CubeTable& table, int least_weight, const int64_t end[3], bool with_edges,
                        int threads) const {
    const std::vector<int64_t> sorted = order();
    const int64_t count = (int64_t)sorted.size();
    std::vector<int64_t> place(count);  // of each block in the order
    for (int64_t i = 0; i < count; i++) place[sorted[i]] = i;
    std::vector<Crossings> crossings(count);
    std::vector<int64_t> vertices(count + 1, 0), faces(count + 1, 0);
    const auto neighbours = [&](int64_t at, int64_t near[8]) {
        for (int n = 0; n < 8; n++) near[n] = n ? find(neighbour(key(sorted[at]), n & 1, n >> 1 & 1, n >> 2)) : sorted[at];
    };

    parallel(count, threads, [&](int64_t at) {
        Corners corners;
        Crossings& c = crossings[at];
        std::memset(&c, 0, sizeof c);
        int64_t near[8];
        neighbours(at, near);
        if (!corners.fill(*this, near, least_weight)) return;
        for (int v = 0; v < kVoxels; v++) {
            const int x = v % kSide, y = v / kSide % kSide, z = v / (kSide * kSide);
            const int here = corners.distance[z][y][x];
            const int next[3] = {corners.distance[z][y][x + 1], corners.distance[z][y + 1][x],
                                 corners.distance[z + 1][y][x]};
            for (int axis = 0; axis < 3; axis++)
                if (here * next[axis] < 0) c.bits[axis][v / 64] |= uint64_t{1} << (v % 64);
        }
        int32_t total = 0;
        for (int axis = 0; axis < 3; axis++)
            for (int word = 0; word < kWords; word++) {
                c.before[axis][word] = total;
                total += __builtin_popcountll(c.bits[axis][word]);
            }
        vertices[at + 1] = total;
    });
    for (int64_t at = 0; at < count; at++) {
        vertices[at + 1] += vertices[at];
        crossings[at].first = vertices[at];
    }

    Triangles out;
    out.vertices.resize(3 * vertices[count]);
    out.colors.resize(3 * vertices[count]);
    if (with_edges) out.edges.resize(vertices[count]);
    parallel(count, threads, [&](int64_t at) {
        if (vertices[at + 1] == vertices[at]) return;
        Corners corners;
        int64_t near[8];
        neighbours(at, near);
        corners.fill(*this, near, least_weight);
        const uint64_t k = key(sorted[at]);
        int64_t base[3];
        for (int axis = 0; axis < 3; axis++)
            base[axis] = ((int64_t)(k >> axis * kBlockBits & ((1u << kBlockBits) - 1)) - kBlockBias) * kSide;
        int64_t vertex = vertices[at];
        for (int axis = 0; axis < 3; axis++)
            for (int v = 0; v < kVoxels; v++) {
                if (!crossings[at].crosses(axis, v)) continue;
                const int p[3] = {v % kSide, v / kSide % kSide, v / (kSide * kSide)};
                const int q[3] = {p[0] + (axis == 0), p[1] + (axis == 1), p[2] + (axis == 2)};
                const float a = corners.distance[p[2]][p[1]][p[0]], b = corners.distance[q[2]][q[1]][q[0]];
                const double share = (double)a / ((double)a - (double)b);
                for (int i = 0; i < 3; i++) {
                    const double lattice = (double)(base[i] + p[i]) + (i == axis ? share : 0.0);
                    out.vertices[3 * vertex + i] = (float)(lattice * voxel_);
                }
                const Block *from = corners.blocks[0][0][0],
                            *to = corners.blocks[q[2] / kSide][q[1] / kSide][q[0] / kSide];
                const int far = (q[2] % kSide * kSide + q[1] % kSide) * kSide + q[0] % kSide;
                for (int i = 0; i < 3; i++) {
                    const double one = from->color[i][v], other = to->color[i][far];
                    out.colors[3 * vertex + i] = (uint8_t)(one + (other - one) * share + 0.5);
                }
                if (with_edges) {
                    int64_t name = axis;
                    for (int i = 2; i >= 0; i--) name = name << 20 | (base[i] + p[i] + (int64_t)kBlockBias * kSide);
                    out.edges[vertex] = name;
                }
                vertex++;
            }
    });

    const auto each_face = [&](int64_t at, int32_t* to) -> int64_t {
        const uint64_t k = key(sorted[at]);
        for (int axis = 0; axis < 3; axis++)
            if ((int64_t)(k >> axis * kBlockBits & ((1u << kBlockBits) - 1)) - kBlockBias >= end[axis]) return 0;
        Corners corners;
        int64_t near[8];
        neighbours(at, near);
        if (!corners.fill(*this, near, least_weight)) return 0;
        int64_t made = 0;
        for (int v = 0; v < kVoxels; v++) {
            const int x = v % kSide, y = v / kSide % kSide, z = v / (kSide * kSide);
            int inside = 0;
            bool whole = true;
            for (int c = 0; c < 8; c++) {
                const int d = corners.distance[z + (c >> 2)][y + (c >> 1 & 1)][x + (c & 1)];
                whole &= d != 0;
                inside |= (d < 0) << c;
            }
            if (!whole || inside == 0 || inside == 255) continue;
            for (const int8_t* e = table.triangles + inside * table.width; *e >= 0; e++, made += 1) {
                if (!to) continue;
                const int32_t* edge = table.edges + 4 * *e;
                const int p[3] = {x + edge[0], y + edge[1], z + edge[2]};
                const int n = p[0] / kSide + 2 * (p[1] / kSide) + 4 * (p[2] / kSide);
                const int voxel = (p[2] % kSide * kSide + p[1] % kSide) * kSide + p[0] % kSide;
                to[made] = (int32_t)crossings[place[near[n]]].vertex(edge[3], voxel);
            }
        }
        return made;
    };
    parallel(count, threads, [&](int64_t at) { faces[at + 1] = each_face(at, nullptr); });
    for (int64_t at = 0; at < count; at++) faces[at + 1] += faces[at];
    out.faces.resize(faces[count]);
    parallel(count, threads, [&](int64_t at) {
        if (faces[at + 1] > faces[at]) each_face(at, out.faces.data() + faces[at]);
    });
    return out;
}

}  // namespace surfkit
