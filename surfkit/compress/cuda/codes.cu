// The nearest code of each vector, and the sums of the vectors of each code; see compress/cuda/codes.py.

namespace {
constexpr int kRows = 128, kCodes = 64, kDepth = 16;  // vectors, codes and dimensions that are in shared memory
constexpr int kThreads = 256, kAcross = 16, kDown = kThreads / kAcross;
constexpr int kMine = kRows / kDown, kTheirs = kCodes / kAcross;  // vectors and codes of a thread
constexpr int kRowStride = kRows + 1, kCodeStride = kCodes + 1;   // odd: the lanes that store use different banks

inline float infinite() { return __int_as_float(0x7f800000); }

// The squared distance as it is defined: in float64, in the order of the dimensions.
inline double distance_to(Buffer<const float> vectors, long long row, Buffer<const float> codes, long long code,
                          int dimensions) {
    double sum = 0;
    for (int j = 0; j < dimensions; j++) {
        const double off = (double)(float)vectors[row * dimensions + j] - (double)(float)codes[code * dimensions + j];
        sum += off * off;
    }
    return sum;
}
}  // namespace

// The nearest code of each vector by float32 distances, where they tell; else -1: when another one is no further away
// than `slack` times as far plus `tiny`, either may be the nearest. `without`, if it is not empty, has a code of each
// vector that does not count.
//
// A block compares 128 vectors with 64 codes at a time, a thread 8 with 4: each value that it reads from shared memory
// takes part in 4 or 8 distances.
KERNEL(kThreads)
approach(Buffer<const float> vectors, Buffer<const float> codes, int dimensions, int count, Buffer<const int> without,
         float slack, float tiny, Buffer<int> found) {
    SHARED(float, some_rows, kDepth* kRowStride);
    SHARED(float, some_codes, kDepth* kCodeStride);
    const long long begin = (long long)blockIdx.x * kRows, rows = found.size;
    const int across = threadIdx.x % kAcross, down = threadIdx.x / kAcross;
    float least[kMine], second[kMine];
    int nearest[kMine], left_out[kMine];
#pragma unroll
    for (int r = 0; r < kMine; r++) {
        const long long row = begin + down + r * kDown;
        least[r] = second[r] = infinite();
        nearest[r] = left_out[r] = -1;
        if (without.size && row < rows) left_out[r] = without[row];
    }
    for (int first = 0; first < count; first += kCodes) {
        float sum[kMine][kTheirs] = {};
        for (int from = 0; from < dimensions; from += kDepth) {
            __syncthreads();
            for (int i = threadIdx.x; i < kRows * kDepth; i += kThreads) {
                const int j = i % kDepth, row = i / kDepth;
                const bool is_there = begin + row < rows && from + j < dimensions;
                some_rows[j * kRowStride + row] = is_there ? vectors[(begin + row) * dimensions + from + j] : 0.0f;
            }
            for (int i = threadIdx.x; i < kCodes * kDepth; i += kThreads) {
                const int j = i % kDepth, code = i / kDepth;
                const bool is_there = first + code < count && from + j < dimensions;
                some_codes[j * kCodeStride + code] =
                    is_there ? codes[(long long)(first + code) * dimensions + from + j] : 0.0f;
            }
            __syncthreads();
#pragma unroll 4
            for (int j = 0; j < kDepth; j++) {
                float x[kMine], c[kTheirs];
#pragma unroll
                for (int r = 0; r < kMine; r++) x[r] = some_rows[j * kRowStride + down + r * kDown];
#pragma unroll
                for (int k = 0; k < kTheirs; k++) c[k] = some_codes[j * kCodeStride + across + k * kAcross];
#pragma unroll
                for (int r = 0; r < kMine; r++)
#pragma unroll
                    for (int k = 0; k < kTheirs; k++) {
                        const float off = x[r] - c[k];
                        sum[r][k] = fmaf(off, off, sum[r][k]);
                    }
            }
        }
#pragma unroll
        for (int k = 0; k < kTheirs; k++) {
            const int code = first + across + k * kAcross;
#pragma unroll
            for (int r = 0; r < kMine; r++) {
                if (code >= count || code == left_out[r]) continue;
                const bool is_nearer = sum[r][k] < least[r];
                second[r] = is_nearer ? least[r] : fminf(second[r], sum[r][k]);
                least[r] = is_nearer ? sum[r][k] : least[r];
                nearest[r] = is_nearer ? code : nearest[r];
            }
        }
    }
#pragma unroll
    for (int r = 0; r < kMine; r++) {
#pragma unroll
        for (int step = kAcross / 2; step > 0; step /= 2) {
            const float other = __shfl_xor_sync(kAllLanes, least[r], step);
            const float its_second = __shfl_xor_sync(kAllLanes, second[r], step);
            const int its_code = __shfl_xor_sync(kAllLanes, nearest[r], step);
            second[r] = fminf(fmaxf(least[r], other), fminf(second[r], its_second));
            nearest[r] = other < least[r] ? its_code : nearest[r];
            least[r] = fminf(least[r], other);
        }
        const long long row = begin + down + r * kDown;
        if (across == 0 && row < rows) found[row] = second[r] > least[r] * slack + tiny ? nearest[r] : -1;
    }
}

// The nearest code of each vector and its distance; a warp goes through all codes where `found` does not tell.
KERNEL(256)
settle(Buffer<const float> vectors, Buffer<const float> codes, int dimensions, int count, Buffer<const int> without,
       Buffer<const int> found, Buffer<int> index, Buffer<float> distance) {
    const long long row = blockIdx.x * 8LL + threadIdx.x / 32;
    if (row >= index.size) return;
    const int lane = threadIdx.x % 32, left_out = without.size ? without[row] : -1;
    int nearest = found[row];
    double least = infinite();
    if (nearest >= 0) {
        if (lane == 0) least = distance_to(vectors, row, codes, nearest, dimensions);
    } else {
        for (int code = lane; code < count; code += 32) {
            const double to_it = code == left_out ? (double)infinite() : distance_to(vectors, row, codes, code, dimensions);
            if (to_it < least) least = to_it, nearest = code;
        }
#pragma unroll
        for (int step = 16; step > 0; step /= 2) {
            const double other = __shfl_xor_sync(kAllLanes, least, step);
            const int its_code = __shfl_xor_sync(kAllLanes, nearest, step);
            const bool is_nearer = other < least || (other == least && its_code >= 0 && its_code < nearest);
            nearest = is_nearer ? its_code : nearest;
            least = is_nearer ? other : least;
        }
    }
    if (lane == 0) {
        index[row] = nearest;
        distance[row] = (float)least;
    }
}

// (codes, D + 1) weighted sums of the vectors of each code, in their order, and of the weights. The vectors of code c are
// those of order[offsets[c]] to order[offsets[c + 1]]. A block for each code, a thread for each column.
KERNEL(64)
sum_by_code(Buffer<const float> vectors, Buffer<const double> weights, Buffer<const long long> order,
            Buffer<const long long> offsets, int dimensions, Buffer<double> sums) {
    const long long code = blockIdx.x, begin = offsets[code], end = offsets[code + 1];
    for (int column = threadIdx.x; column <= dimensions; column += 64) {
        double sum = 0;
        for (long long at = begin; at < end; at++) {
            const long long row = order[at];
            const double weight = weights[row];
            sum += column < dimensions ? weight * (double)(float)vectors[row * dimensions + column] : weight;
        }
        sums[code * (dimensions + 1) + column] = sum;
    }
}
