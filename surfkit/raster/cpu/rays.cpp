#include "rays.h"

#include <limits>

#include "../native/pool.h"

namespace surfkit {
namespace {

using splat::CameraModel;
using splat::Posed;
using splat::Vec;

constexpr int64_t kChunk = 1024;  // splats projected as one piece of work

// A tile and a row that touches it.
struct Touch {
    uint32_t tile, row;
};

// What kernels need of an ellipsoid, and where its alpha may reach kAlphaMin: the outline of that contour. False if it is
// not drawn.
bool cast(const SplatArrays& s, int64_t i, const CameraModel<double>& cam, RaySplat& out, splat::Bound<double>& bound) {
    splat::SplatIn<double> in{};
    in.mean = {s.means[3 * i], s.means[3 * i + 1], s.means[3 * i + 2]};
    for (int k = 0; k < 4; k++) in.quat[k] = s.quats[4 * i + k];
    const Posed<double> p = splat::pose(in, cam);
    const double opacity = s.opacities[i];
    if (!(p.c.z > cam.near) || !(opacity > (double)splat::kAlphaMin)) return false;
    const double k2 = 2 * std::log(opacity / (double)splat::kAlphaMin) * 1.00001 + 1e-5;
    const Vec<double> c{cam.fx * p.c.x + cam.cx * p.c.z, cam.fy * p.c.y + cam.cy * p.c.z, p.c.z};
    double xx = -c.x * c.x, xy = -c.x * c.y, yy = -c.y * c.y, xz = -c.x * c.z, yz = -c.y * c.z, zz = 0;
    for (int k = 0; k < 3; k++) {
        const Vec<double> r = splat::column(p.axes, k);
        const double scale = s.scales[3 * i + k], h = k2 * scale * scale;
        const double u = cam.fx * r.x + cam.cx * r.z, v = cam.fy * r.y + cam.cy * r.z;
        xx += h * u * u;
        xy += h * u * v;
        yy += h * v * v;
        xz += h * u * r.z;
        yz += h * v * r.z;
        zz += h * r.z * r.z;
        out.r[0][k] = r.x / cam.fx / scale;
        out.r[1][k] = r.y / cam.fy / scale;
        out.r[2][k] = (r.z - cam.cx / cam.fx * r.x - cam.cy / cam.fy * r.y) / scale;
        out.o[k] = -dot(r, p.c) / scale;
    }
    out.opacity = (float)opacity;
    out.z_low = (float)((p.c.z - std::sqrt(zz)) * (1 - 1e-6) - 1e-12);
    if (!(zz / k2 * splat::kCutoffSquared < c.z * c.z)) return false;
    const double d = zz - c.z * c.z;  // of the dual conic of the outline
    const double mx = xz / d, my = yz / d, pad = 1e-2;
    bound = {mx, my, 1.0001 * (mx * mx - xx / d) + pad, mx * my - xy / d, 1.0001 * (my * my - yy / d) + pad, mx, my,
             -1};
    return std::isfinite(bound.hxx + bound.hxy + bound.hyy);
}

// Points of each tile, nearest first.
std::vector<std::vector<int64_t>> by_tile(const CameraModel<double>& cam, const double* points, int64_t count,
                                          int tiles_x, int tiles, float* opacity, int threads) {
    std::vector<std::vector<int64_t>> inside(tiles);
    for (int64_t i = 0; i < count; i++) {
        const double x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        opacity[i] = std::numeric_limits<float>::quiet_NaN();
        if (z > cam.near && x >= 0 && y >= 0 && x < cam.width && y < cam.height)
            inside[(size_t)((int)y / kTile) * tiles_x + (int)x / kTile].push_back(i);
    }
    parallel(tiles, threads, [&](int64_t t) {
        std::sort(inside[t].begin(), inside[t].end(),
                  [&](int64_t a, int64_t b) { return points[3 * a + 2] < points[3 * b + 2]; });
    });
    return inside;
}

}  // namespace

void ray_opacity(const SplatArrays& splats, const CameraModel<double>& cam, const double* points, int64_t count,
                 bool solid, float* opacity, int threads) {
    const int tiles_x = (cam.width + kTile - 1) / kTile, tiles_y = (cam.height + kTile - 1) / kTile,
              tiles = tiles_x * tiles_y;
    const auto inside = by_tile(cam, points, count, tiles_x, tiles, opacity, threads);
    const int64_t chunks = (splats.count + kChunk - 1) / kChunk;
    std::vector<RaySplat> rays(splats.count);
    std::vector<std::vector<Touch>> touches(chunks);
    parallel(chunks, threads, [&](int64_t c) {
        std::vector<Touch> found;
        for (int64_t i = c * kChunk; i < std::min(splats.count, (c + 1) * kChunk); i++) {
            splat::Bound<double> bound;
            if (!cast(splats, i, cam, rays[i], bound)) continue;
            each_tile(bound, splat::outline(bound), 0.0, 0.0, tiles_x, tiles_y, 0.0, [&](uint32_t tile) {
                if (!inside[tile].empty()) found.push_back({tile, (uint32_t)i});
            });
        }
        touches[c] = std::move(found);
    });
    std::vector<int64_t> start(tiles + 1, 0);
    for (const auto& some : touches)
        for (const Touch& t : some) start[t.tile + 1]++;
    for (int t = 0; t < tiles; t++) start[t + 1] += start[t];
    std::vector<uint32_t> rows(start[tiles]);
    std::vector<int64_t> next(start.begin(), start.end() - 1);
    for (const auto& some : touches)
        for (const Touch& t : some) rows[next[t.tile]++] = t.row;
    const Kernels& k = kernels();
    parallel(tiles, threads, [&](int64_t tile) {
        const std::vector<int64_t>& here = inside[tile];
        if (here.empty()) return;
        const size_t size = (here.size() + kProbes - 1) / kProbes * kProbes;
        std::vector<float> x(size), y(size), z(size), open(size, 1.0f);
        const double ox = tile % tiles_x * kTile + kTile / 2, oy = tile / tiles_x * kTile + kTile / 2;
        for (size_t j = 0; j < size; j++) {
            const double* p = points + 3 * here[std::min(j, here.size() - 1)];
            x[j] = (float)(p[0] - ox);
            y[j] = (float)(p[1] - oy);
            z[j] = (float)p[2];
        }
        k.ray_probe(solid, rays.data(), rows.data() + start[tile], start[tile + 1] - start[tile], ox, oy,
                    (float)cam.near, {(int64_t)size, x.data(), y.data(), z.data(), open.data()});
        for (size_t j = 0; j < here.size(); j++) opacity[here[j]] = 1 - open[j];
    });
}

}  // namespace surfkit
