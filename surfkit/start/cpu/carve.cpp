#include "carve.h"

#include <algorithm>
#include <cmath>

#include "../../raster/native/pool.h"

namespace surfkit {
namespace {

constexpr int kRays = 4096;   // of a piece of work
constexpr int kAround = 2;    // voxels in each direction that tell which way a surface faces
constexpr double kStep = 0.5;  // voxels

// Narrow the k for which a + k b >= 0.
inline void require(double a, double b, double& low, double& high) {
    if (b > 0) {
        low = std::max(low, -a / b);
    } else if (b < 0) {
        high = std::min(high, -a / b);
    } else if (a < 0) {
        high = low - 1;
    }
}

}  // namespace

void carve(const CarveGrid& grid, const CarveView& view, uint8_t* surfaces, uint8_t* through, int threads) {
    const double* p = view.pose;
    parallel(std::max(0, view.high[0] - view.low[0]), threads, [&](int64_t row) {
        const int64_t i = view.low[0] + row;
        for (int j = view.low[1]; j < view.high[1]; j++) {
            // Along a column, pixel coordinates times depth, and depth, are linear in k.
            const double x0 = p[0] * i + p[1] * j + p[3], y0 = p[4] * i + p[5] * j + p[7], z0 = p[8] * i + p[9] * j + p[11];
            const double u0 = view.fx * x0 + view.cx * z0, u1 = view.fx * p[2] + view.cx * p[10];
            const double v0 = view.fy * y0 + view.cy * z0, v1 = view.fy * p[6] + view.cy * p[10];
            double low = 0, high = grid.size[2] - 1;
            require(z0 - 1, p[10], low, high);  // a voxel and more in front of the camera
            require(u0, u1, low, high);
            require(v0, v1, low, high);
            require(view.width * z0 - u0, view.width * p[10] - u1, low, high);
            require(view.height * z0 - v0, view.height * p[10] - v1, low, high);
            if (!(low <= high)) continue;
            const int64_t column = (i * grid.size[1] + j) * grid.size[2];
            for (int k = (int)std::ceil(low); k <= (int)std::floor(high); k++) {
                const double z = z0 + k * p[10], turn = 1 / z;
                const int u = std::clamp((int)((u0 + k * u1) * turn), 0, view.width - 1);
                const int v = std::clamp((int)((v0 + k * v1) * turn), 0, view.height - 1);
                // Without branches, as no voxel tells which way the next one goes.
                const double found = view.depth[(int64_t)v * view.width + u];
                const bool known = found > 0, beyond = found > z + view.beyond, near = std::fabs(found - z) <= view.near;
                uint8_t &to_surfaces = surfaces[column + k], &to_through = through[column + k];
                to_surfaces += known & near & (to_surfaces < 255);
                to_through += known & beyond & (to_through < 255);
            }
        }
    });
}

void meet(const CarveGrid& grid, const uint8_t* solid, const double* from, const float* rays, int64_t count, float* lengths,
          float* outward, int threads) {
    const auto at = [&](int64_t x, int64_t y, int64_t z) { return solid[(x * grid.size[1] + y) * grid.size[2] + z]; };
    parallel((count + kRays - 1) / kRays, threads, [&](int64_t piece) {
        for (int64_t ray = piece * kRays; ray < std::min(count, (piece + 1) * kRays); ray++) {
            lengths[ray] = 0;
            std::fill(outward + 3 * ray, outward + 3 * ray + 3, 0.0f);
            const double way[3] = {rays[3 * ray], rays[3 * ray + 1], rays[3 * ray + 2]};
            double low = 0, high = 1e30;
            for (int a = 0; a < 3; a++) {
                require(from[a] + 0.5, way[a], low, high);
                require(grid.size[a] - 0.5 - from[a], -way[a], low, high);
            }
            const double step = kStep / std::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
            for (double t = low + step / 2; t <= high; t += step) {
                int64_t c[3];  // the nearest voxel; within the grid, no position is below -0.5
                for (int a = 0; a < 3; a++) c[a] = std::clamp((int)(from[a] + t * way[a] + 0.5), 0, grid.size[a] - 1);
                if (!at(c[0], c[1], c[2])) continue;
                lengths[ray] = (float)t;
                for (int x = -kAround; x <= kAround; x++)
                    for (int y = -kAround; y <= kAround; y++)
                        for (int z = -kAround; z <= kAround; z++) {
                            const int64_t q[3] = {c[0] + x, c[1] + y, c[2] + z};
                            bool inside = true;
                            for (int a = 0; a < 3; a++) inside &= q[a] >= 0 && q[a] < grid.size[a];
                            if (!inside || !at(q[0], q[1], q[2])) continue;
                            outward[3 * ray] -= (float)x, outward[3 * ray + 1] -= (float)y, outward[3 * ray + 2] -= (float)z;
                        }
                break;
            }
        }
    });
}

}  // namespace surfkit
