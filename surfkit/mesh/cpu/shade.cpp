#include "shade.h"

#include <algorithm>
#include <cmath>

#include "../../native/pool.h"

namespace surfkit {
namespace {

constexpr int kBand = 32;  // rows of the picture in one piece of work

// The first pixel whose centre lies at `at` or beyond, and one past the last whose centre lies before it, in [low, high].
// A corner that is hardly in front of the camera falls far out of what an int can hold.
int first_pixel(double at, int low, int high) {
    return (int)std::max<double>(low, std::min<double>(high, std::ceil(at - 0.5)));
}
int end_pixel(double at, int low, int high) {
    return (int)std::max<double>(low, std::min<double>(high, std::floor(at - 0.5) + 1));
}

// The rows [from, to) of one triangle; inverse depth is linear on the picture. Of equal depths the first face stays.
void draw(const FaceJob& job, int32_t face, int from, int to) {
    const int32_t* f = job.faces + 3 * (int64_t)face;
    double x[3], y[3], inverse[3];
    for (int i = 0; i < 3; i++) {
        const float* v = job.vertices + 3 * (int64_t)f[i];
        if (!(v[2] > 0)) return;
        x[i] = v[0], y[i] = v[1], inverse[i] = 1.0 / v[2];
    }
    const double low = std::min({y[0], y[1], y[2]}), high = std::max({y[0], y[1], y[2]});
    if (high < from || low > to) return;
    const double area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
    if (area == 0 || !std::isfinite(area)) return;
    const int y0 = first_pixel(low, from, to), y1 = end_pixel(high, from, to);
    const double left = std::min({x[0], x[1], x[2]}), right = std::max({x[0], x[1], x[2]});
    if (right < 0 || left > job.width) return;
    const int x0 = first_pixel(left, 0, job.width), x1 = end_pixel(right, 0, job.width);
    for (int row = y0; row < y1; row++)
        for (int col = x0; col < x1; col++) {
            const double px = col + 0.5, py = row + 0.5;
            const double b = ((px - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (py - y[0])) / area;
            const double c = ((x[1] - x[0]) * (py - y[0]) - (px - x[0]) * (y[1] - y[0])) / area;
            if (b < 0 || c < 0 || b + c > 1) continue;
            const float depth = (float)(1.0 / (inverse[0] + b * (inverse[1] - inverse[0]) + c * (inverse[2] - inverse[0])));
            const int64_t at = (int64_t)row * job.width + col;
            if (depth < job.depth[at]) {
                job.depth[at] = depth;
                job.face[at] = face;
            }
        }
}

}  // namespace

void draw_faces(const FaceJob& job, int threads) {
    parallel((job.height + kBand - 1) / kBand, threads, [&](int64_t band) {
        const int from = (int)band * kBand, to = std::min(job.height, from + kBand);
        for (int64_t face = 0; face < job.count; face++) draw(job, (int32_t)face, from, to);
    });
}

}  // namespace surfkit
