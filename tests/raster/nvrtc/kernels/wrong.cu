// Kernels with one mistake each, which the emulator must find.
KERNEL(64) beyond_the_end(Buffer<const float> x, Buffer<float> out) {
    if (threadIdx.x <= x.size) out[threadIdx.x] = x[threadIdx.x];
}

KERNEL(64) no_barrier(Buffer<int> out) {
    SHARED(int, part, 64);
    part[threadIdx.x] = threadIdx.x;
    out[threadIdx.x] = part[63 - threadIdx.x];
}

// The next round writes what others still read.
KERNEL(64) one_barrier_of_two(Buffer<int> out) {
    SHARED(int, part, 64);
    int sum = 0;
    for (int i = 0; i < 3; i++) {
        part[threadIdx.x] = i;
        __syncthreads();
        sum += part[63 - threadIdx.x];
    }
    out[threadIdx.x] = sum;
}

KERNEL(32) no_syncwarp(Buffer<int> out) {
    SHARED(int, part, 32);
    part[threadIdx.x] = threadIdx.x;
    out[threadIdx.x] = part[31 - threadIdx.x];
}

// Orders each half with itself, but values go from one to the other.
KERNEL(32) half_syncwarp(Buffer<int> out) {
    SHARED(int, part, 32);
    part[threadIdx.x] = threadIdx.x;
    __syncwarp(threadIdx.x < 16 ? 0xffffu : 0xffff0000u);
    out[threadIdx.x] = part[31 - threadIdx.x];
}

KERNEL(64) syncwarp_between_warps(Buffer<int> out) {
    SHARED(int, part, 64);
    part[threadIdx.x] = threadIdx.x;
    __syncwarp();
    out[threadIdx.x] = part[63 - threadIdx.x];
}

KERNEL(64) no_atomic(Buffer<int> out) {
    SHARED(int, sum, 1);
    if (threadIdx.x == 0) sum[0] = 0;
    __syncthreads();
    sum[0] += 1;
    __syncthreads();
    if (threadIdx.x == 0) out[0] = sum[0];
}

KERNEL(32) no_atomic_between_blocks(Buffer<int> out) {
    if (threadIdx.x == 0) out[0] += 1;
}

KERNEL(32) reads_what_another_block_writes(Buffer<int> x) {
    if (threadIdx.x == 0 && blockIdx.x < x.size - 1) x[blockIdx.x] = x[blockIdx.x + 1];
}

KERNEL(32) atomic_and_plain(Buffer<int> x) {
    atomicAdd(&x[0], 1);
    if (threadIdx.x == 0) x[1] = x[0];
}

// Only thread 0 may read this way, and only behind a barrier.
KERNEL(64) global_no_barrier(Buffer<int> x) {
    x[threadIdx.x] = threadIdx.x;
    x[64 + threadIdx.x] = x[63 - threadIdx.x];
}

KERNEL(64) never_written(Buffer<int> out) {
    SHARED(int, part, 64);
    if (threadIdx.x != 5) part[threadIdx.x] = 1;
    __syncthreads();
    out[threadIdx.x] = part[threadIdx.x];
}

KERNEL(64) barrier_for_some(Buffer<int> out) {
    if (threadIdx.x < 40) __syncthreads();
    out[threadIdx.x] = 1;
}

KERNEL(64) two_barriers(Buffer<int> out) {
    if (threadIdx.x < 40)
        __syncthreads();
    else
        __syncthreads();
    out[threadIdx.x] = 1;
}

KERNEL(32) shuffle_for_some(Buffer<int> out) {
    if (threadIdx.x < 7) return;
    out[threadIdx.x] = __shfl_xor_sync(kAllLanes, (int)threadIdx.x, 1);
}

KERNEL(32) shuffle_of_others(Buffer<int> out) {
    const unsigned mask = 0xffff;
    if (threadIdx.x < 16) out[threadIdx.x] = __shfl_xor_sync(mask, (int)threadIdx.x, 16);
}

KERNEL(32) foreign_mask(Buffer<int> out) { out[threadIdx.x] = __any_sync(1u, 1); }

KERNEL(64) half_a_warp(Buffer<int> out) { out[threadIdx.x] = __any_sync(kAllLanes, 1); }

KERNEL(32) different_calls(Buffer<int> out) {
    out[threadIdx.x] = threadIdx.x < 16 ? __any_sync(kAllLanes, 1) : __all_sync(kAllLanes, 1);
}

// Waits for another thread, which a GPU need not run meanwhile.
KERNEL(32) spins(Buffer<int> out) {
    if (threadIdx.x == 31) atomicExch(&out[0], 1);
    if (threadIdx.x == 0)
        while (atomicAdd(&out[0], 0) == 0) {
        }
    if (threadIdx.x == 1)
        while (atomicAdd(&out[1], 0) == 0) {
        }
}
