#include "agreement.h"

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace surfkit {

void agreement(const AgreementJob& job, int row) {
    const int64_t first = (int64_t)row * job.width;
    const float* inverse = job.inverse + first;
    float *count = job.count + first, *shown = job.shown + first, *fused = job.fused + first;
    std::fill(count, count + job.width, 0.0f);
    std::fill(shown, shown + job.width, 0.0f);
    std::fill(fused, fused + job.width, 1.0f);  // the sum of depths carried over, as shares of the depth here
    const double y = (row + 0.5 - job.cy) / job.fy;
    for (const AgreementMap& other : job.others) {
        const double* t = other.way;
        const float shift[3] = {(float)t[9], (float)t[10], (float)t[11]};
        for (int column = 0; column < job.width; column++) {
            const float w = inverse[column];
            if (!(w > 0)) continue;
            const double x = (column + 0.5 - job.cx) / job.fx;
            float at[3];
            for (int i = 0; i < 3; i++) at[i] = (float)(t[3 * i] * x + t[3 * i + 1] * y + t[3 * i + 2]) + w * shift[i];
            if (!(at[2] > 0)) continue;
            const float u = at[0] / at[2], v = at[1] / at[2];
            if (!(u >= 0 && v >= 0 && u < (float)other.width && v < (float)other.height)) continue;
            const float found = other.inverse[(int64_t)v * other.width + (int64_t)u];
            if (!(found > 0)) continue;
            shown[column] += 1;
            const float ratio = found * at[2] / std::max(w, 1e-20f);
            if (!(std::fabs(ratio - 1) < job.tolerance)) continue;
            count[column] += 1;
            fused[column] += ratio;
        }
    }
    for (int column = 0; column < job.width; column++) fused[column] = inverse[column] * fused[column] / (count[column] + 1);
}

}  // namespace surfkit
