// Mean structural similarity of two images (C, H, W) and its gradient; see raster/ssim.py for the definition.
//
// A block makes a tile of 32 x 16 pixels of one channel. The 11 x 11 window is blurred across, then down, each thread
// four neighbouring pixels at a time: they share 14 loads of shared memory that would be 44. Strides are odd, so that
// the lanes of a warp, which take rows when blurring across and columns when blurring down, use different banks.

constexpr int kRadius = 5;
constexpr int kWidth = 32, kHeight = 16, kThreads = 128;
constexpr int kRows = kHeight + 2 * kRadius, kColumns = kWidth + 2 * kRadius;
constexpr int kStride = kColumns + 1, kBlurredStride = kWidth + 1;
constexpr int kTile = kRows * kStride, kBlurred = kRows * kBlurredStride;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

// exp(-i^2 / (2 1.5^2)), i = 0 .. 5, over the sum of all eleven.
constexpr float kWindow[kRadius + 1] = {0.2660117249f,  0.2130055377f,   0.1093606895f,
                                        0.03600077213f, 0.007598758135f, 0.001028380084f};

inline float weight(int i) { return kWindow[i < kRadius ? kRadius - i : i - kRadius]; }

struct Place {
    int x, y, width, height;
    long long plane;  // first value of the channel
};
inline Place place(int width, int height) {
    return {(int)blockIdx.x * kWidth, (int)blockIdx.y * kHeight, width, height, (long long)blockIdx.z * width * height};
}

// A tile of an image and what is around it, zeros beyond the image.
inline void load_tile(Buffer<const float> image, Place at, SharedArray<float> tile, int offset) {
    for (int i = threadIdx.x; i < kRows * kColumns; i += kThreads) {
        const int row = i / kColumns, column = i % kColumns;
        const int y = at.y + row - kRadius, x = at.x + column - kRadius;
        const bool inside = x >= 0 && x < at.width && y >= 0 && y < at.height;
        tile[offset + row * kStride + column] = inside ? image[at.plane + (long long)y * at.width + x] : 0.0f;
    }
}

// Four neighbours in a row, blurred across.
inline void store_four(SharedArray<float> blurred, int offset, int row, int column, const float* sum) {
#pragma unroll
    for (int c = 0; c < 4; c++) blurred[offset + row * kBlurredStride + column + c] = sum[c];
}

// Four neighbours in a column, blurred down.
inline void blur_down(SharedArray<float> blurred, int offset, int row, int column, float* sum) {
#pragma unroll
    for (int c = 0; c < 4; c++) sum[c] = 0;
#pragma unroll
    for (int i = 0; i < 4 + 2 * kRadius; i++) {
        const float value = blurred[offset + (row + i) * kBlurredStride + column];
#pragma unroll
        for (int c = 0; c < 4; c++)
            if (i >= c && i - c <= 2 * kRadius) sum[c] = fmaf(value, weight(i - c), sum[c]);
    }
}

// sums: of the similarities of each block's pixels. d_*: derivatives of the similarity of each pixel by the blurred x,
// x^2 + y^2 and x y, where they are wanted (else empty).
KERNEL(128)
ssim_forward(Buffer<const float> x, Buffer<const float> y, int width, int height, Buffer<float> sums,
             Buffer<float> d_mean, Buffer<float> d_square, Buffer<float> d_cross) {
    SHARED(float, tile, 2 * kTile);
    SHARED(float, blurred, 4 * kBlurred);
    SHARED(float, warps, kThreads / 32);
    const Place at = place(width, height);
    load_tile(x, at, tile, 0);
    load_tile(y, at, tile, kTile);
    __syncthreads();
    for (int item = threadIdx.x; item < kRows * (kWidth / 4); item += kThreads) {
        const int row = item % kRows, column = item / kRows * 4;
        float mx[4] = {}, my[4] = {}, square[4] = {}, cross[4] = {};
#pragma unroll
        for (int i = 0; i < 4 + 2 * kRadius; i++) {
            const float a = tile[row * kStride + column + i], b = tile[kTile + row * kStride + column + i];
            const float s = fmaf(a, a, b * b), p = a * b;
#pragma unroll
            for (int c = 0; c < 4; c++) {
                if (i < c || i - c > 2 * kRadius) continue;
                const float w = weight(i - c);
                mx[c] = fmaf(a, w, mx[c]);
                my[c] = fmaf(b, w, my[c]);
                square[c] = fmaf(s, w, square[c]);
                cross[c] = fmaf(p, w, cross[c]);
            }
        }
        store_four(blurred, 0, row, column, mx);
        store_four(blurred, kBlurred, row, column, my);
        store_four(blurred, 2 * kBlurred, row, column, square);
        store_four(blurred, 3 * kBlurred, row, column, cross);
    }
    __syncthreads();
    const int column = threadIdx.x % kWidth, row = threadIdx.x / kWidth * 4;
    float mx[4], my[4], square[4], cross[4], sum = 0;
    blur_down(blurred, 0, row, column, mx);
    blur_down(blurred, kBlurred, row, column, my);
    blur_down(blurred, 2 * kBlurred, row, column, square);
    blur_down(blurred, 3 * kBlurred, row, column, cross);
#pragma unroll
    for (int c = 0; c < 4; c++) {
        const int px = at.x + column, py = at.y + row + c;
        if (px >= width || py >= height) continue;
        const float a = mx[c], b = my[c], means = fmaf(a, a, b * b), ab = a * b;
        const float p1 = 2 * ab + kC1, q1 = means + kC1;
        const float p2 = 2 * (cross[c] - ab) + kC2, q2 = square[c] - means + kC2;
        const float inv1 = 1 / q1, inv2 = 1 / q2, inv = inv1 * inv2, s = p1 * p2 * inv;
        sum += s;
        if (d_mean.size == 0) continue;
        const long long i = at.plane + (long long)py * width + px;
        d_mean[i] = 2 * inv * (b * (p2 - p1)) - 2 * s * a * (inv1 - inv2);
        d_square[i] = -(s * inv2);
        d_cross[i] = 2 * p1 * inv;
    }
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x == 0) {
        const long long block = ((long long)blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
        sums[block] = (warps[0] + warps[1]) + (warps[2] + warps[3]);
    }
}

// The gradient by x of upstream[0] times the mean: the window is symmetric, so derivatives are blurred like values.
KERNEL(128)
ssim_backward(Buffer<const float> x, Buffer<const float> y, int width, int height, Buffer<const float> d_mean,
              Buffer<const float> d_square, Buffer<const float> d_cross, Buffer<const float> upstream,
              Buffer<float> gradient) {
    SHARED(float, tile, 3 * kTile);
    SHARED(float, blurred, 3 * kBlurred);
    const Place at = place(width, height);
    load_tile(d_mean, at, tile, 0);
    load_tile(d_square, at, tile, kTile);
    load_tile(d_cross, at, tile, 2 * kTile);
    __syncthreads();
    for (int item = threadIdx.x; item < kRows * (kWidth / 4); item += kThreads) {
        const int row = item % kRows, column = item / kRows * 4;
#pragma unroll
        for (int k = 0; k < 3; k++) {
            float sum[4] = {};
#pragma unroll
            for (int i = 0; i < 4 + 2 * kRadius; i++) {
                const float value = tile[k * kTile + row * kStride + column + i];
#pragma unroll
                for (int c = 0; c < 4; c++)
                    if (i >= c && i - c <= 2 * kRadius) sum[c] = fmaf(value, weight(i - c), sum[c]);
            }
            store_four(blurred, k * kBlurred, row, column, sum);
        }
    }
    __syncthreads();
    const int column = threadIdx.x % kWidth, row = threadIdx.x / kWidth * 4;
    float mean[4], square[4], cross[4];
    blur_down(blurred, 0, row, column, mean);
    blur_down(blurred, kBlurred, row, column, square);
    blur_down(blurred, 2 * kBlurred, row, column, cross);
    const float scale = upstream[0] / (float)gradient.size;
#pragma unroll
    for (int c = 0; c < 4; c++) {
        const int px = at.x + column, py = at.y + row + c;
        if (px >= width || py >= height) continue;
        const long long i = at.plane + (long long)py * width + px;
        gradient[i] = scale * fmaf(2 * x[i], square[c], fmaf(y[i], cross[c], mean[c]));
    }
}
