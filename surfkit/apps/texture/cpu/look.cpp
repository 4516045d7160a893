#include "look.h"

#include <algorithm>
#include <cmath>

#include "../../../raster/native/pool.h"

namespace surfkit {
namespace {

constexpr int64_t kFaces = 1024;  // in one piece of work

void look_at(const LookJob& job, int64_t face) {
    const int32_t* f = job.faces + 3 * face;
    double x[3], y[3], inverse[3];
    for (int i = 0; i < 3; i++) {
        const float* v = job.vertices + 3 * (int64_t)f[i];
        if (!(v[2] > 0 && v[0] >= 0 && v[0] < job.width && v[1] >= 0 && v[1] < job.height)) return;
        x[i] = v[0], y[i] = v[1], inverse[i] = 1.0 / v[2];
    }
    const int64_t plane = (int64_t)job.width * job.height;
    int32_t covered = 0, hidden = 0;
    int64_t sums[3] = {0, 0, 0};
    const auto meet = [&](int row, int col, double depth) {
        const int64_t at = (int64_t)row * job.width + col;
        covered++;
        if ((float)depth > job.depth[at] * (1.0f + job.slack)) {
            hidden++;
            return;
        }
        for (int i = 0; i < 3; i++) sums[i] += job.color[i * plane + at];
    };
    const double area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    const int y0 = std::max(0, (int)std::ceil(std::min({y[0], y[1], y[2]}) - 0.5));
    const int y1 = std::min(job.height, (int)std::floor(std::max({y[0], y[1], y[2]}) - 0.5) + 1);
    const int x0 = std::max(0, (int)std::ceil(std::min({x[0], x[1], x[2]}) - 0.5));
    const int x1 = std::min(job.width, (int)std::floor(std::max({x[0], x[1], x[2]}) - 0.5) + 1);
    if (area != 0)
        for (int row = y0; row < y1; row++)
            for (int col = x0; col < x1; col++) {
                const double px = col + 0.5, py = row + 0.5;
                const double b = ((px - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (py - y[0])) / area;
                const double c = ((x[1] - x[0]) * (py - y[0]) - (px - x[0]) * (y[1] - y[0])) / area;
                if (b < 0 || c < 0 || b + c > 1) continue;
                meet(row, col, 1.0 / (inverse[0] + b * (inverse[1] - inverse[0]) + c * (inverse[2] - inverse[0])));
            }
    if (!covered)  // between the centres: its middle stands for it
        meet((int)((y[0] + y[1] + y[2]) / 3), (int)((x[0] + x[1] + x[2]) / 3),
             3.0 / (inverse[0] + inverse[1] + inverse[2]));
    job.covered[face] = covered;
    job.hidden[face] = hidden;
    for (int i = 0; i < 3; i++) job.sums[3 * face + i] = (float)sums[i];
}

}  // namespace

void look(const LookJob& job, int threads) {
    parallel((job.count + kFaces - 1) / kFaces, threads, [&](int64_t piece) {
        const int64_t last = std::min(job.count, (piece + 1) * kFaces);
        for (int64_t face = piece * kFaces; face < last; face++) look_at(job, face);
    });
}

}  // namespace surfkit
