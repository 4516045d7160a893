#include "shade.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../../raster/native/pool.h"

namespace surfkit {
namespace {

constexpr int kBand = 32;            // rows of the picture in one piece of work
constexpr int64_t kPiece = 1 << 16;  // faces

// The first pixel whose centre lies at `at` or beyond, and one past the last whose centre lies before it, in [low, high].
// A corner that is hardly in front of the camera falls far out of what an int can hold.
int first_pixel(double at, int low, int high) {
    return (int)std::max<double>(low, std::min<double>(high, std::ceil(at - 0.5)));
}
int end_pixel(double at, int low, int high) {
    return (int)std::max<double>(low, std::min<double>(high, std::floor(at - 0.5) + 1));
}

struct Bands {
    int first, end;
};

// The bands of the picture that a triangle may touch; none if it is not drawn.
Bands bands_of(const FaceJob& job, int32_t face) {
    const int32_t* f = job.faces + 3 * (int64_t)face;
    double low = INFINITY, high = -INFINITY;
    for (int i = 0; i < 3; i++) {
        const float* v = job.vertices + 3 * (int64_t)f[i];
        if (!(v[2] > 0) || std::isnan(v[1])) return {0, 0};
        low = std::min<double>(low, v[1]), high = std::max<double>(high, v[1]);
    }
    const int first = first_pixel(low, 0, job.height), end = end_pixel(high, 0, job.height);
    return first < end ? Bands{first / kBand, (end - 1) / kBand + 1} : Bands{0, 0};
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
    const int bands = (job.height + kBand - 1) / kBand;
    const int64_t pieces = (job.count + kPiece - 1) / kPiece;
    if (!bands || !pieces) return;
    // The faces of each piece by the bands that they touch, in their order.
    std::vector<std::vector<int32_t>> touched(pieces);
    std::vector<std::vector<int64_t>> ends(pieces);
    parallel(pieces, threads, [&](int64_t piece) {
        const int64_t from = piece * kPiece, to = std::min(job.count, from + kPiece);
        std::vector<int64_t> next(bands + 1, 0);
        for (int64_t face = from; face < to; face++) {
            const Bands b = bands_of(job, (int32_t)face);
            for (int band = b.first; band < b.end; band++) next[band + 1]++;
        }
        for (int band = 0; band < bands; band++) next[band + 1] += next[band];
        std::vector<int32_t> faces(next[bands]);
        for (int64_t face = from; face < to; face++) {
            const Bands b = bands_of(job, (int32_t)face);
            for (int band = b.first; band < b.end; band++) faces[next[band]++] = (int32_t)face;
        }
        touched[piece] = std::move(faces);
        next.pop_back();
        ends[piece] = std::move(next);
    });
    parallel(bands, threads, [&](int64_t band) {
        const int from = (int)band * kBand, to = std::min(job.height, from + kBand);
        for (int64_t piece = 0; piece < pieces; piece++)
            for (int64_t at = band ? ends[piece][band - 1] : 0; at < ends[piece][band]; at++)
                draw(job, touched[piece][at], from, to);
    });
}

}  // namespace surfkit
