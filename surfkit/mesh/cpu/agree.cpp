#include "agree.h"

#include <algorithm>
#include <cstdint>

namespace surfkit {
namespace {

struct Map {
    const float* values;
    int width, height;
    float at(float x, float y) const {  // 0 outside of the picture
        if (!(x >= 0 && x < (float)width && y >= 0 && y < (float)height)) return 0;
        return values[(int64_t)y * width + (int64_t)x];
    }
    // The least that there is, of a pixel that has some and those around it.
    float nearest(float x, float y) const {
        float least = at(x, y);
        if (!(least > 0)) return 0;
        const int column = (int)x, row = (int)y;
        for (int v = std::max(row - 1, 0); v <= std::min(row + 1, height - 1); v++)
            for (int u = std::max(column - 1, 0); u <= std::min(column + 1, width - 1); u++)
                if (const float value = values[(int64_t)v * width + u]; value > 0) least = std::min(least, value);
        return least;
    }
};

}  // namespace

void agree(const AgreeJob& job, int row) {
    const Map here{job.depth, job.lens.width, job.lens.height}, there{job.other, job.other_width, job.other_height};
    const Lens& l = job.lens;
    const double* t = job.way;
    const float shift[3] = {(float)t[9], (float)t[10], (float)t[11]};
    const float far = 1 + job.tolerance, near = 1 - job.tolerance;
    for (int column = 0; column < job.lens.width; column++) {
        const int64_t pixel = (int64_t)row * job.lens.width + column;
        float &agreement = job.agreement[pixel], &against = job.against[pixel], &looks = job.looks[pixel];
        agreement = against = looks = 0;
        const float depth = job.depth[pixel];
        if (!(depth > 0)) continue;
        const double ray[2] = {(column + 0.5 - l.cx) / l.fx, (row + 0.5 - l.cy) / l.fy};
        const float inverse = 1 / std::max(depth, 1e-20f);
        float at[3];  // in the picture of the other view, times its z for a depth of 1
        for (int i = 0; i < 3; i++)
            at[i] = (float)(t[3 * i] * ray[0] + t[3 * i + 1] * ray[1] + t[3 * i + 2]) + inverse * shift[i];
        if (!(at[2] > 0)) continue;
        const float found = there.at(at[0] / at[2], at[1] / at[2]);
        if (!(found > 0)) continue;
        looks = 1;
        const float ratio = found / (at[2] * depth);
        const float off = (ratio - 1) / job.tolerance;
        agreement = std::max(1 - off * off, 0.0f);
        // Beside an edge it takes all pixels around to see through: which of them a point falls on is chance there.
        if (ratio > far && there.nearest(at[0] / at[2], at[1] / at[2]) > far * at[2] * depth) against = 1;
        if (!(ratio < near)) continue;
        // What hides the point lies on the line from the other view's centre to it.
        const float r[3] = {(float)ray[0], (float)ray[1], 1};
        float p[3];
        for (int i = 0; i < 3; i++) p[i] = job.eye[i] + (r[i] * depth - job.eye[i]) * ratio;
        if (!(p[2] > 0)) continue;
        const float beyond = here.nearest(p[0] / p[2] * l.fx + l.cx, p[1] / p[2] * l.fy + l.cy);
        if (beyond > 0 && beyond > p[2] * far) against = 1;
    }
}

}  // namespace surfkit
