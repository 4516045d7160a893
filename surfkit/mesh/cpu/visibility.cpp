#include "visibility.h"

#include <algorithm>
#include <cmath>

namespace surfkit {
namespace {

constexpr float LEAST_FACING = 0.1f;  // cosine between ray and normal from which a surface is seen
constexpr float LEAST_SLANT = 0.25f;
constexpr int64_t HALF = int64_t{1} << (CELL_BITS - 1);
constexpr int VALUES = 10;
constexpr int STEPS = 10000;  // a walk is not longer, in whatever came of rounding

uint64_t scattered(uint64_t key) {
    key *= 0x9e3779b97f4a7c15u;
    return key ^ key >> 32;
}

void grow(Cells& cells) {
    size_t size = std::max<size_t>(1024, 2 * cells.table.size());
    cells.table.assign(size, -1);
    for (int64_t row = 0; row < cells.rows; row++) {
        size_t slot = scattered((uint64_t)cells.keys[row]) & (size - 1);
        while (cells.table[slot] >= 0) slot = (slot + 1) & (size - 1);
        cells.table[slot] = row;
    }
}

double* sums_of(Cells& cells, int64_t key) {
    if (2 * (size_t)cells.rows >= cells.table.size()) grow(cells);
    size_t slot = scattered((uint64_t)key) & (cells.table.size() - 1);
    while (cells.table[slot] >= 0 && cells.keys[cells.table[slot]] != key) slot = (slot + 1) & (cells.table.size() - 1);
    if (cells.table[slot] < 0) {
        cells.table[slot] = cells.rows++;
        cells.keys.push_back(key);
        cells.sums.resize(cells.sums.size() + VALUES, 0.0);
    }
    return &cells.sums[VALUES * cells.table[slot]];
}

struct Seen {
    float x, y, z;      // camera coordinates
    int64_t pixel = -1;  // that it falls on; -1 outside of the picture
};

Seen look(const Sight& sight, const float* p) {
    const auto& r = sight.pose.turn;
    Seen s;
    s.x = (float)(r[0][0] * p[0] + r[0][1] * p[1] + r[0][2] * p[2] + sight.pose.shift[0]);
    s.y = (float)(r[1][0] * p[0] + r[1][1] * p[1] + r[1][2] * p[2] + sight.pose.shift[1]);
    s.z = (float)(r[2][0] * p[0] + r[2][1] * p[1] + r[2][2] * p[2] + sight.pose.shift[2]);
    if (!(s.z > 0)) return s;
    const float u = s.x / s.z * sight.lens.fx + sight.lens.cx, v = s.y / s.z * sight.lens.fy + sight.lens.cy;
    if (!(u >= 0 && u < (float)sight.lens.width && v >= 0 && v < (float)sight.lens.height)) return s;
    s.pixel = (int64_t)v * sight.lens.width + (int64_t)u;
    return s;
}

// Cosine between the ray to a place and the normal there, and that normal in the camera's frame.
float facing(const Sight& sight, const Seen& s, const float* n, float turned[3]) {
    for (int i = 0; i < 3; i++) {
        const auto& r = sight.pose.turn[i];
        turned[i] = (float)(r[0] * n[0] + r[1] * n[1] + r[2] * n[2]);
    }
    const float length = std::sqrt(s.x * s.x + s.y * s.y + s.z * s.z);
    return -(turned[0] * s.x + turned[1] * s.y + turned[2] * s.z) / length;
}

// Distance from the plane that a pixel shows for each unit of depth before or behind it: along the ray, what is full
// behind a wall that is seen from the side would be a thin shell.
float slant_of(const Sight& sight, const Seen& s) {
    const int64_t pixels = (int64_t)sight.lens.width * sight.lens.height;
    float n[3], square = 0;
    for (int k = 0; k < 3; k++) n[k] = sight.normal[k * pixels + s.pixel], square += n[k] * n[k];
    if (!(square > 0)) return 1;
    return std::max(-(n[0] * s.x + n[1] * s.y + n[2] * s.z) / (s.z * std::sqrt(square)), LEAST_SLANT);
}

}  // namespace

int64_t cell_key(const int64_t at[3]) {
    return (at[0] + HALF) << 2 * CELL_BITS | (at[1] + HALF) << CELL_BITS | (at[2] + HALF);
}

void Cells::add(const Sight& sight, double limit) {
    const Lens& l = sight.lens;
    const auto& r = sight.pose.turn;
    const int64_t pixels = (int64_t)l.width * l.height;
    for (int map = 0; map < sight.maps; map++)
        for (int64_t pixel = 0; pixel < pixels; pixel++) {
            const double z = sight.depth[map * pixels + pixel], weight = sight.weight[map * pixels + pixel];
            if (!(z > 0 && z < limit && weight > 0)) continue;
            const double x = ((double)(pixel % l.width) + 0.5 - l.cx) / l.fx * z - sight.pose.shift[0];
            const double y = ((double)(pixel / l.width) + 0.5 - l.cy) / l.fy * z - sight.pose.shift[1];
            const double w = z - sight.pose.shift[2];
            double place[3], n[3], length = 0;
            int64_t at[3];
            bool within = true;
            for (int i = 0; i < 3; i++) {
                place[i] = r[0][i] * x + r[1][i] * y + r[2][i] * w;
                at[i] = (int64_t)std::floor(place[i] / side);
                within = within && at[i] >= low[i] && at[i] < high[i];
                const double c = sight.normal[i * pixels + pixel];
                length += c * c;
            }
            if (!within) continue;
            const double unit = length > 0 ? weight / std::sqrt(length) : 0;
            for (int i = 0; i < 3; i++)
                n[i] = unit * (r[0][i] * sight.normal[pixel] + r[1][i] * sight.normal[pixels + pixel] +
                               r[2][i] * sight.normal[2 * pixels + pixel]);
            double* sum = sums_of(*this, cell_key(at));
            sum[0] += weight;
            for (int i = 0; i < 3; i++) {
                sum[1 + i] += weight * (place[i] - at[i] * side);
                sum[4 + i] += n[i];
                sum[7 + i] += weight * sight.color[i * pixels + pixel];
            }
        }
}

bool may_see(const Sight& sight, const float* low, const float* high) {
    const Lens& l = sight.lens;
    bool behind = true, left = true, right = true, above = true, below = true;
    for (int corner = 0; corner < 8; corner++) {
        double p[3], c[3];
        for (int i = 0; i < 3; i++) p[i] = corner >> i & 1 ? high[i] : low[i];
        for (int i = 0; i < 3; i++) {
            const auto& r = sight.pose.turn[i];
            c[i] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + sight.pose.shift[i];
        }
        // Sides of the pyramid of the picture, a pixel wider; they hold for corners behind the camera too.
        const double u = c[0] * l.fx + l.cx * c[2], v = c[1] * l.fy + l.cy * c[2];
        behind = behind && c[2] <= 0;
        left = left && u < -c[2], right = right && u > (l.width + 1) * c[2];
        above = above && v < -c[2], below = below && v > (l.height + 1) * c[2];
    }
    return !(behind || left || right || above || below);
}

void vote(const VoteJob& job, const Sight& sight, int64_t from, int64_t to) {
    const int64_t pixels = (int64_t)sight.lens.width * sight.lens.height;
    for (int64_t i = from; i < to; i++) {
        const Seen s = look(sight, job.places + 3 * i);
        if (s.pixel < 0) continue;
        const float slant = slant_of(sight, s);
        for (int map = 0; map < sight.maps; map++) {
            const float depth = sight.depth[map * pixels + s.pixel], weight = sight.weight[map * pixels + s.pixel];
            if (!(depth > 0 && weight > 0)) continue;
            const float before = (depth - s.z) * slant / (job.noise * depth);
            if (before >= 0) {
                job.empty[i] += weight * std::min(before, 1.0f);
            } else if (before > -job.thickness) {  // sure at one deviation behind the depth, less from half of it on
                job.full[i] += weight * std::min({-before, 1.0f, 2 * (1 + before / job.thickness)});
            }
        }
    }
}

void confirm(const ConfirmJob& job, const Sight& sight, int64_t from, int64_t to) {
    const int64_t pixels = (int64_t)sight.lens.width * sight.lens.height;
    for (int64_t i = from; i < to; i++) {
        const Seen s = look(sight, job.places + 3 * i);
        if (s.pixel < 0) continue;
        float n[3];
        const float cosine = facing(sight, s, job.normals + 3 * i, n);
        if (!(cosine > LEAST_FACING)) continue;
        bool near = false;
        for (int map = 0; map < sight.maps; map++) {
            const float depth = sight.depth[map * pixels + s.pixel], weight = sight.weight[map * pixels + s.pixel];
            near = near || (depth > 0 && weight > 0 && std::fabs(depth - s.z) * cosine <= job.tolerance);
        }
        if (near) job.views[i] += 1;
    }
}

void pull(const PullJob& job, const Sight& sight, int64_t from, int64_t to) {
    const Lens& l = sight.lens;
    const int64_t pixels = (int64_t)l.width * l.height;
    for (int64_t i = from; i < to; i++) {
        const Seen s = look(sight, job.places + 3 * i);
        if (s.pixel < 0) continue;
        float n[3];
        const float cosine = facing(sight, s, job.normals + 3 * i, n);
        if (!(cosine > LEAST_FACING)) continue;
        float a[3], length = 0;
        for (int k = 0; k < 3; k++) a[k] = sight.normal[k * pixels + s.pixel], length += a[k] * a[k];
        length = std::sqrt(length);
        const float along = (a[0] * n[0] + a[1] * n[1] + a[2] * n[2]) / length;
        if (!(length > 0 && along > 0.3f)) continue;  // another side of an edge
        bool counts = false;
        const float column = (float)(s.pixel % l.width) + 0.5f, row = (float)(s.pixel / l.width) + 0.5f;
        for (int map = 0; map < sight.maps; map++) {
            const float depth = sight.depth[map * pixels + s.pixel], weight = sight.weight[map * pixels + s.pixel];
            if (!(depth > 0 && weight > 0)) continue;
            // From the place along its normal to the plane that the pixel shows.
            const float x = (column - l.cx) / l.fx * depth - s.x, y = (row - l.cy) / l.fy * depth - s.y;
            const float far = (x * a[0] + y * a[1] + (depth - s.z) * a[2]) / length / along, share = far / job.reach;
            if (!(std::fabs(share) < 1)) continue;
            const float size = std::min(job.near / depth, 1.0f), rest = 1 - share * share;
            const float counted = weight * cosine * size * size * rest * rest;  // Tukey's weights
            job.sum[i] += counted * far, job.weight[i] += counted, job.square[i] += counted * far * far;
            counts = true;
        }
        if (counts) job.views[i] += 1;
    }
}

int32_t locate(const Walk& walk, const double* place, int32_t start) {
    int32_t t = start, from = -1;
    for (int step = 0; step < STEPS; step++) {
        const int32_t* c = walk.corners + 4 * (int64_t)t;
        int go = -1;
        for (int turn = 0; turn < 4 && go < 0; turn++) {
            const int i = (turn + step) & 3;
            const double* p[4];
            for (int k = 0; k < 4; k++) p[k] = k == i ? place : walk.points + 3 * (int64_t)c[k];
            double e[3][3];
            for (int k = 0; k < 3; k++)
                for (int j = 0; j < 3; j++) e[k][j] = p[k + 1][j] - p[0][j];
            const double volume = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) +
                                  e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
                                  e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]);
            const int32_t next = walk.neighbours[4 * (int64_t)t + i];
            if (volume < 0 && (next < 0 || next != from)) go = i;
        }
        if (go < 0) return t;
        from = t;
        t = walk.neighbours[4 * (int64_t)t + go];
        if (t < 0) return -1;
    }
    return t;
}

double volume(const Walk& walk, int64_t tet) {
    const int32_t* c = walk.corners + 4 * tet;
    double e[3][3];
    for (int k = 0; k < 3; k++)
        for (int j = 0; j < 3; j++) e[k][j] = walk.points[3 * (int64_t)c[k + 1] + j] - walk.points[3 * (int64_t)c[0] + j];
    return std::fabs(e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) + e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
                     e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0])) / 6;
}

void price(const CostJob& job, const Walk& walk, int64_t tet) {
    for (int i = 0; i < 4; i++) {
        int32_t& cost = job.cost[4 * tet + i];
        const int32_t next = walk.neighbours[4 * tet + i];
        cost = 0;
        int32_t c[3];
        for (int k = 0, found = 0; k < 4; k++)
            if (k != i) c[found++] = walk.corners[4 * tet + k];
        std::sort(c, c + 3);  // so that both sides come to the same cost
        if (next < 0 || c[1] >= job.count) continue;
        if (c[2] >= job.count) {  // beyond the rim: as an edge of the surface that is one cell wide
            double square = 0;
            for (int j = 0; j < 3; j++) {
                const double apart = walk.points[3 * (int64_t)c[1] + j] - walk.points[3 * (int64_t)c[0] + j];
                square += apart * apart;
            }
            cost = (int32_t)std::lround(std::min(UNITS * std::sqrt(square) / job.side, 1e8));
            continue;
        }
        double e[2][3], n[3], size = 0, mean = 0;
        for (int k = 0; k < 2; k++)
            for (int j = 0; j < 3; j++) e[k][j] = walk.points[3 * (int64_t)c[k + 1] + j] - walk.points[3 * (int64_t)c[0] + j];
        for (int j = 0; j < 3; j++) {
            n[j] = e[0][(j + 1) % 3] * e[1][(j + 2) % 3] - e[0][(j + 2) % 3] * e[1][(j + 1) % 3];
            size += n[j] * n[j];
        }
        size = std::sqrt(size);
        for (int k = 0; k < 3; k++)
            for (int j = 0; j < 3; j++) mean += n[j] * job.normals[3 * (int64_t)c[k] + j] / 3;
        const double turned = size > 0 ? 1 - std::fabs(mean) / size : 0;
        const double votes = (job.evidence[tet] + job.evidence[next]) / 2;
        const double share = (job.aligned + (1 - job.aligned) * turned) * (job.sure + (1 - job.sure) / (1 + votes / job.certain));
        cost = (int32_t)std::lround(std::min(UNITS * size / 2 / (job.side * job.side) * share, 1e8));
    }
}

}  // namespace surfkit
