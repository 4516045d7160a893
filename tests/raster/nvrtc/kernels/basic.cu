// Small correct kernels that use each feature of the emulator.
KERNEL(256) halve(Buffer<const float> x, Buffer<float> y) {
    const long long i = blockIdx.x * 256LL + threadIdx.x;
    if (i < y.size) y[i] = 0.5f * x[i];
}

KERNEL(128) block_sums(Buffer<const float> x, Buffer<float> sums) {
    SHARED(float, part, 4);
    const long long i = blockIdx.x * 128LL + threadIdx.x;
    const float sum = warp_sum(i < x.size ? x[i] : 0.0f);
    if (threadIdx.x % 32 == 0) part[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x == 0) sums[blockIdx.x] = part[0] + part[1] + part[2] + part[3];
}

// Inclusive prefix sums of each 32.
KERNEL(64) warp_scan(Buffer<const int> x, Buffer<int> sums) {
    const int lane = threadIdx.x % 32;
    int value = x[threadIdx.x];
    for (int step = 1; step < 32; step *= 2) {
        const int before = __shfl_up_sync(kAllLanes, value, step);
        if (lane >= step) value += before;
    }
    sums[threadIdx.x] = value;
}

KERNEL(256) histogram(Buffer<const int> x, Buffer<int> counts) {
    SHARED(int, part, 10);
    if (threadIdx.x < 10) part[threadIdx.x] = 0;
    __syncthreads();
    const long long i = blockIdx.x * 256LL + threadIdx.x;
    if (i < x.size) atomicAdd(&part[x[i]], 1);
    __syncthreads();
    if (threadIdx.x < 10) atomicAdd(&counts[threadIdx.x], part[threadIdx.x]);
}

// Through shared memory, in a block of two dimensions.
KERNEL(64) transpose(Buffer<const float> x, Buffer<float> out, int width, int height) {
    SHARED(float, tile, 8 * 9);
    const int column = blockIdx.x * 8 + threadIdx.x, row = blockIdx.y * 8 + threadIdx.y;
    if (column < width && row < height) tile[threadIdx.y * 9 + threadIdx.x] = x[row * width + column];
    __syncthreads();
    const int to_column = blockIdx.y * 8 + threadIdx.x, to_row = blockIdx.x * 8 + threadIdx.y;
    if (to_column < height && to_row < width) out[to_row * height + to_column] = tile[threadIdx.x * 9 + threadIdx.y];
}

// Votes, and shuffles of each kind: [ballot, any, all, from lane 3, xor 1, up 1, down 1, xor within 8 lanes].
KERNEL(32) collectives(Buffer<const int> x, Buffer<int> out) {
    const int lane = threadIdx.x, value = x[lane];
    out[lane * 8] = (int)__ballot_sync(kAllLanes, value > 0);
    out[lane * 8 + 1] = __any_sync(kAllLanes, value == 5);
    out[lane * 8 + 2] = __all_sync(kAllLanes, value < 100);
    out[lane * 8 + 3] = __shfl_sync(kAllLanes, value, 3);
    out[lane * 8 + 4] = __shfl_xor_sync(kAllLanes, value, 1);
    out[lane * 8 + 5] = __shfl_up_sync(kAllLanes, value, 1);
    out[lane * 8 + 6] = __shfl_down_sync(kAllLanes, value, 1);
    out[lane * 8 + 7] = __shfl_xor_sync(kAllLanes, value, 7, 8);
}

// Halves of a warp that go separate ways; only part of it meets in each.
KERNEL(32) halves(Buffer<int> out) {
    const unsigned low = 0xffff;
    const int lane = threadIdx.x;
    out[lane] = lane < 16 ? __shfl_xor_sync(low, lane, 1) : __shfl_xor_sync(~low, lane, 2);
}

// The values of a warp in reverse order, ordered by __syncwarp alone.
KERNEL(64) reverse(Buffer<const int> x, Buffer<int> out) {
    SHARED(int, part, 64);
    part[threadIdx.x] = x[threadIdx.x];
    __syncwarp();
    const int value = part[threadIdx.x ^ 31];
    __syncwarp();
    part[threadIdx.x] = value;
    out[threadIdx.x] = part[threadIdx.x];
}

KERNEL(64) vote(Buffer<const int> x, Buffer<int> out) {
    const int p = x[threadIdx.x];
    const int count = __syncthreads_count(p > 0), all = __syncthreads_and(p > 0), any = __syncthreads_or(p > 1);
    if (threadIdx.x == 0) {
        out[0] = count;
        out[1] = all;
        out[2] = any;
    }
}

struct Affine {
    float scale[2];
    int shift;
};
KERNEL(32) apply(Affine a, Buffer<const float2> x, Buffer<float2> out, bool is_shifted) {
    const float2 v = x[threadIdx.x];
    const float shift = is_shifted ? a.shift : 0;
    out[threadIdx.x] = make_float2(a.scale[0] * v.x + shift, a.scale[1] * v.y + shift);
}

KERNEL(64) shift(Buffer<const int> x, Buffer<int> out) {
    if (threadIdx.x < 63) out[threadIdx.x] = x[threadIdx.x + 1];
}
