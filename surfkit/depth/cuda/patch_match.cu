// One pass of PatchMatch over the pixels of one colour of the checkerboard, a thread each; see depth/cuda/passes.py. What
// is computed is what depth/cpu/stereo.cpp computes, which says why; only the order of sums differs.
#include "../stereo_terms.h"

using namespace surfkit;

// A picture to compare with, as in depth/cpu/stereo.h. Its pixels and its map begin at `first` and `first_inverse` of the
// buffers that hold those of all.
struct View {
    long long first, first_inverse;
    int width, height, stride, inverse_width, inverse_height;  // the last are 0 without a map
    float gain, to_inverse[2], way[12], back[12];
};

// A pass over the planes of a picture, as in depth/cpu/stereo.h.
struct Job {
    int width, height, count, best, survey;
    unsigned seed;
    float fx, fy, cx, cy;
    float low, high, parallax, jitter_px, smoothness, consistency, spread, brightness, stretch;
    float offset_x[kSamples], offset_y[kSamples], nearness[kSamples];
};

namespace {

constexpr int kThreads = 128, kWide = 32;  // of a block, and of one row of it
constexpr int kTrials = 9;                 // planes that are tried together, at most

struct Plane {
    float w, gx, gy;
};

// To the left, the right, above and below.
inline int step_x(int i) { return (i == 1) - (i == 0); }
inline int step_y(int i) { return (i == 3) - (i == 2); }

// Draws that depend on pixel and pass alone, in [-1, 1).
struct Draw {
    unsigned state;
    float next() {
        state = state * 747796405u + 2891336453u;
        const unsigned word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737u;
        return (float)(int)((word >> 22) ^ word) * (1.0f / 2147483648.0f);
    }
};

// The grey value between four pixels, times 64 * 64.
inline float between(unsigned four, int right, int down) {
    const int upper = (int)(four & 255u) * (kOne - right) + (int)(four >> 8 & 255u) * right;
    const int under = (int)(four >> 16 & 255u) * (kOne - right) + (int)(four >> 24) * right;
    return (float)(upper * (kOne - down) + under * down);
}

// Where the middle of the window falls in a view on a plane, and what a step in the window moves it by.
struct Place {
    float u, v, ux, uy, vx, vy;
    bool is_shown;

    Place(const Job& job, const View& s, float x, float y, const Plane& p) {
        const float* m = s.way;
        const float z = p.w * m[11] + (m[6] * x + m[7] * y + m[8]), turn = 1.0f / fmaxf(z, 1e-20f);
        const float zx = p.gx * m[11] + m[6], zy = p.gy * m[11] + m[7];
        u = (p.w * m[9] + (m[0] * x + m[1] * y + m[2])) * turn;
        v = (p.w * m[10] + (m[3] * x + m[4] * y + m[5])) * turn;
        ux = (p.gx * m[9] + m[0] - u * zx) * turn, uy = (p.gy * m[9] + m[1] - u * zy) * turn;
        vx = (p.gx * m[10] + m[3] - v * zx) * turn, vy = (p.gy * m[10] + m[4] - v * zy) * turn;
        is_shown = z > 0 && u >= 0 && v >= 0 && u <= (float)(s.width - 1) && v <= (float)(s.height - 1) &&
                   fabsf(ux) + fabsf(uy) <= job.stretch && fabsf(vx) + fabsf(vy) <= job.stretch;
    }
};

// The window of a pixel, in registers: weights that sum to 1; the same times the grey values less their mean.
struct Window {
    float weight[SAMPLES], centred[SAMPLES], contrast, mean;

    Window(const Job& job, Buffer<const unsigned> here, long long middle) {
        const int stride = job.width + 2 * kBorder;
        const float own = (float)(here[middle] & 255u);
        float all = kTiny, square = 0;
        mean = 0;
#pragma unroll
        for (int j = 0; j < SAMPLES; j++) {
            const float value = (float)(here[middle + (int)job.offset_y[j] * stride + (int)job.offset_x[j]] & 255u);
            weight[j] = job.nearness[j] * __expf(-fabsf(value - own) / job.spread);
            centred[j] = value;
            all += weight[j], mean += weight[j] * value;
        }
        mean /= all;
#pragma unroll
        for (int j = 0; j < SAMPLES; j++) {
            weight[j] /= all;
            const float off = centred[j] - mean;
            centred[j] = weight[j] * off;
            square += centred[j] * off;
        }
        contrast = square + kNoise;
    }
};

// Inverse depths of the four neighbours, and how much they count: 0 where there is none.
struct Around {
    float inverse[4], alike[4];
    bool is_there[4];
};

// Planes that are tried together, what they cost before any view is looked at, and how they match in each of the views.
struct Trials {
    Plane plane[kTrials];
    float price[kTrials], match[kMostViews][kTrials];
    int count;

    void add(const Plane& p) { plane[count++] = p; }

    // Keep the planes that cost least in the views looked at so far.
    void drop_worst(int seen) {
        if (count <= kKept) return;
        float so_far[kTrials];
        for (int i = 0; i < count; i++) {
            float sum = 0;
            for (int k = 0; k < seen; k++) sum += fminf(match[k][i], 1.0f);
            so_far[i] = price[i] + sum / (float)seen;
        }
        int left = 0;
        for (int i = 0; i < count && left < kKept; i++) {
            int better = 0;
            for (int j = 0; j < count; j++) better += so_far[j] < so_far[i];
            if (better >= kKept) continue;
            plane[left] = plane[i], price[left] = price[i];
            for (int k = 0; k < seen; k++) match[k][left] = match[k][i];
            left++;
        }
        count = left;
    }

    // The soft minimum of the `best` least matches of a plane in `views` views.
    float least(int i, int views, int best) const {
        float sorted[kMostViews];
        const int most = min(best, views);
        for (int k = 0; k < most; k++) sorted[k] = kNever;
        for (int k = 0; k < views; k++) {
            float more = match[k][i];
            for (int j = 0; j < most; j++) {
                const float less = fminf(sorted[j], more);
                more = fmaxf(sorted[j], more), sorted[j] = less;
            }
        }
        float sum = 1, used = 1;
        for (int k = 1; k < most; k++)
            if (sorted[k] < kNothing) sum += __expf((sorted[0] - sorted[k]) / kHidden), used += 1;
        return sorted[0] - __logf(sum / used) * kHidden;
    }
};

// A pixel, and the state of all.
struct Pixel {
    const Job& job;
    const int x, y;
    Buffer<const View> views;
    Buffer<const unsigned> pictures;
    Buffer<const float> inverses;
    Buffer<float3> planes;
    Buffer<float> costs;
    Buffer<unsigned char> each;

    long long at(int px, int py) const { return (long long)py * job.width + px; }

    bool has(int px, int py) const { return px >= 0 && py >= 0 && px < job.width && py < job.height; }

    Plane known(int px, int py) const {
        const float3 p = planes[at(px, py)];
        return {p.x, p.y, p.z};
    }

    // The plane of another pixel, as it goes on to this one.
    Plane carried(int px, int py) const {
        Plane p = known(px, py);
        p.w += p.gx * (float)(x - px) + p.gy * (float)(y - py);
        return p;
    }

    Around neighbours(Buffer<const unsigned> here, long long middle) const {
        Around out;
        const float own = (float)(here[middle] & 255u);
#pragma unroll
        for (int i = 0; i < 4; i++) {
            const int px = x + step_x(i), py = y + step_y(i);
            out.is_there[i] = has(px, py);
            out.inverse[i] = out.alike[i] = 0;
            if (!out.is_there[i]) continue;
            const float value = (float)(here[middle + step_y(i) * (job.width + 2 * kBorder) + step_x(i)] & 255u);
            out.inverse[i] = known(px, py).w;
            out.alike[i] = __expf(-fabsf(value - own) / job.spread);
        }
        return out;
    }

    // What the pixel misses itself by when it is carried to a view, and back by the depth found there (ACMM).
    float missed(const View& s, float u, float v) const {
        const int column = (int)((u + 0.5f) * s.to_inverse[0]), row = (int)((v + 0.5f) * s.to_inverse[1]);
        if (column >= s.inverse_width || row >= s.inverse_height) return kMostError;
        const float found = inverses[s.first_inverse + (long long)row * s.inverse_width + column];
        const float* m = s.back;
        const float z = u * m[6] + v * m[7] + m[8] + found * m[11];
        if (!(found > 0 && z > 0)) return kMostError;
        const float off_x = (u * m[0] + v * m[1] + m[2] + found * m[9]) / z - (float)x;
        const float off_y = (u * m[3] + v * m[4] + m[5] + found * m[10]) / z - (float)y;
        return fminf(kMostError, sqrtf(off_x * off_x + off_y * off_y));
    }

    // 1 - correlation of the window with what a view shows on a plane, the cost of their difference in brightness, and the
    // reprojection error; kNothing where the view does not show it.
    float compared(const Window& window, const View& s, const Plane& p) const {
        const Place place(job, s, (float)x, (float)y, p);
        if (!place.is_shown) return kNothing;
        const float border = (float)kBorder * kOne + 0.5f;
        const float u = place.u * kOne + border, v = place.v * kOne + border;
        const float ux = place.ux * kOne, uy = place.uy * kOne, vx = place.vx * kOne, vy = place.vy * kOne;
        float mean = 0, square = 0, both = 0;
#pragma unroll
        for (int j = 0; j < SAMPLES; j++) {
            const int at_x = (int)(ux * job.offset_x[j] + (uy * job.offset_y[j] + u));
            const int at_y = (int)(vx * job.offset_x[j] + (vy * job.offset_y[j] + v));
            const unsigned four = pictures[s.first + (long long)(at_y >> kFraction) * s.stride + (at_x >> kFraction)];
            const float value = between(four, at_x & (kOne - 1), at_y & (kOne - 1)) * (1.0f / (kOne * kOne));
            const float weighed = window.weight[j] * value;
            mean += weighed, square += weighed * value, both += window.centred[j] * value;
        }
        const float contrast = fmaxf(0.0f, square - mean * mean) + kNoise;
        const float bright = mean * s.gain, both_bright = (bright + window.mean) * 0.5f + kDark;
        const float unlike = fminf(kUnlike, fabsf(bright - window.mean) / both_bright * job.brightness);
        const float apart = fmaxf(0.0f, 1.0f - both / sqrtf(contrast * window.contrast));
        const float off = fminf(1.0f, apart + unlike);
        return s.inverse_width ? off + job.consistency * missed(s, place.u, place.v) : off;
    }

    static unsigned char told(float match) { return (unsigned char)(int)(fminf(match, 1.0f) * 255.0f); }

    // The views to look at, and their number: those that match best here and around, at most kLooked for each that counts.
    int choose(const Window& window, const Around& around, const Plane& plane, int* chosen) const {
        const long long here = at(x, y) * job.count;
        int vote[kMostViews], beside = 0;
        for (int view = 0; view < job.count; view++) {
            if (job.survey) {
                const View s = views[view];
                each[here + view] = told(compared(window, s, plane));
            }
            vote[view] = 2 * (int)each[here + view];
        }
#pragma unroll
        for (int i = 0; i < 4; i++) {
            if (!around.is_there[i]) continue;
            const long long there = at(x + step_x(i), y + step_y(i)) * job.count;
            for (int view = 0; view < job.count; view++) vote[view] += (int)each[there + view];
            beside++;
        }
        const int nothing = (2 + beside) * 255;  // of views that show neither this pixel nor those around it
        const int most = min(kLooked * job.best, job.count);
        unsigned taken = 0;
        for (int found = 0; found < most; found++) {
            int least = -1;
            for (int view = 0; view < job.count; view++)
                if (!(taken >> view & 1u) && (least < 0 || vote[view] < vote[least])) least = view;
            if (found && vote[least] >= nothing) return found;
            taken |= 1u << least;
            chosen[found] = least;
        }
        return most;
    }

    // Prices of the trials by how much they differ from what lies around. Planes are dropped that are out of range, oblique,
    // or like one before them; and the first, the present one, if its cost is known.
    void screen(const Window& window, const Around& around, bool is_known, Trials& trials) const {
        const float rx = ((float)x + 0.5f - job.cx) / job.fx, ry = ((float)y + 0.5f - job.cy) / job.fy;
        const float smoothness = job.smoothness / 4 * (1.0f + kFaint / window.contrast);
        const float away = kOblique * kOblique * (rx * rx + ry * ry + 1.0f), same = kSame / job.parallax;
        Plane before[kTrials];
        int left = 0;
        for (int i = 0; i < trials.count; i++) {
            const Plane p = before[i] = trials.plane[i];
            const float nx = p.gx * job.fx, ny = p.gy * job.fy, nz = p.w - nx * rx - ny * ry;
            bool fits = job.low <= p.w && p.w <= job.high && (nx * nx + ny * ny + nz * nz) * away < p.w * p.w;
            for (int j = 0; j < i; j++) {
                const float by = fabsf(before[j].gx - p.gx) + fabsf(before[j].gy - p.gy);
                if (by * kAcross + fabsf(before[j].w - p.w) < same) fits = false;
            }
            if (i == 0 ? is_known : !fits) continue;
            float rough = 0;
#pragma unroll
            for (int j = 0; j < 4; j++) {
                const float there = p.w + p.gx * (float)step_x(j) + p.gy * (float)step_y(j);
                rough += around.alike[j] * fminf(kMostBend, fabsf(there - around.inverse[j]) * job.parallax);
            }
            trials.price[left] = fits ? rough * smoothness : kNever;
            trials.plane[left++] = p;
        }
        trials.count = left;
    }

    // Planes of the neighbours, and of the best of those further away in each direction.
    void propagate(const Around& around, Trials& trials) const {
#pragma unroll
        for (int i = 0; i < 4; i++) {
            if (!around.is_there[i]) continue;
            trials.add(carried(x + step_x(i), y + step_y(i)));
            int best = 0;
            float least = kNever;
            for (int far = 3; far <= kFarthest; far += 2) {
                const int px = x + far * step_x(i), py = y + far * step_y(i);
                if (!has(px, py)) break;
                if (const float c = costs[at(px, py)]; c < least) best = far, least = c;
            }
            if (best) trials.add(carried(x + best * step_x(i), y + best * step_y(i)));
        }
    }

    // The slopes that the neighbours make, and a small change at random.
    void refine(const Around& around, const Plane& plane, Trials& trials) const {
        const float* w = around.inverse;
        if (around.is_there[0] && around.is_there[1] && around.is_there[2] && around.is_there[3]) {
            trials.add({plane.w, (w[1] - w[0]) / 2, (w[3] - w[2]) / 2});
            trials.add({(w[0] + w[1] + w[2] + w[3]) / 4, plane.gx, plane.gy});
        }
        Draw draw{job.seed ^ (unsigned)at(x, y) * 2654435761u};
        const float by = job.jitter_px / job.parallax;
        const float dw = by * draw.next(), dx = by * draw.next() / kRadius, dy = by * draw.next() / kRadius;
        trials.add({plane.w + dw, plane.gx, plane.gy});
        trials.add({plane.w, plane.gx + dx, plane.gy + dy});
    }
};

}  // namespace

KERNEL(kThreads, BLOCKS)
improve(Job job, int colour, Buffer<const View> views, Buffer<const unsigned> here, Buffer<const unsigned> pictures,
        Buffer<const float> inverses, Buffer<float3> planes, Buffer<float> costs, Buffer<unsigned char> each) {
    const int y = blockIdx.y * (kThreads / kWide) + threadIdx.x / kWide;
    const int x = 2 * (blockIdx.x * kWide + threadIdx.x % kWide) + ((y + colour) & 1);
    if (x >= job.width || y >= job.height) return;
    const long long middle = (long long)(y + kBorder) * (job.width + 2 * kBorder) + x + kBorder;
    const Pixel pixel{job, x, y, views, pictures, inverses, planes, costs, each};
    const Window window(job, here, middle);
    const Around around = pixel.neighbours(here, middle);
    Plane plane = pixel.known(x, y);
    int chosen[kMostViews];
    const int looked = pixel.choose(window, around, plane, chosen);
    float cost = kNever;
    Trials trials;
    // Take the best of those that are tried, first the planes of others, then changes of what is found.
    for (int turn = 0; turn < 2; turn++) {
        trials.count = 0;
        trials.add(plane);
        if (turn == 0) pixel.propagate(around, trials);
        else pixel.refine(around, plane, trials);
        pixel.screen(window, around, turn == 1, trials);
        for (int k = 0; k < looked; k++) {
            if (k == job.best) trials.drop_worst(k);
            const View s = views[chosen[k]];
            for (int i = 0; i < trials.count; i++) trials.match[k][i] = pixel.compared(window, s, trials.plane[i]);
        }
        int best = -1;
        for (int i = 0; i < trials.count; i++)
            if (const float all = trials.price[i] + trials.least(i, looked, job.best); all < cost) best = i, cost = all;
        if (best < 0) continue;
        plane = trials.plane[best];
        for (int k = 0; k < looked; k++) each[pixel.at(x, y) * job.count + chosen[k]] = Pixel::told(trials.match[k][best]);
    }
    planes[pixel.at(x, y)] = make_float3(plane.w, plane.gx, plane.gy);
    costs[pixel.at(x, y)] = cost;
}
