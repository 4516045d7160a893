// What every CUDA source of surfkit may use; it is put in front of each. The same source is compiled by NVRTC for a GPU
// and, with EMULATED defined, by a C++ compiler for tests without one. So that both can:
// - global memory is reached through Buffer, shared memory through SHARED, never through bare pointers; elements are
//   read and written whole: `const float4 v = x[i]`, then v.x. Templates take a copy: `f(float(x[i]))`.
// - device functions need no `__device__`, everything is one; they name a Buffer or a SharedArray as their parameter.
// - every thread of a block arrives at every barrier: none returns before the last one.
// - no header is included but those of surfkit.
//
//   KERNEL(256) halve(Buffer<const float> x, Buffer<float> y) {
//       const long long i = blockIdx.x * 256LL + threadIdx.x;
//       if (i < y.size) y[i] = 0.5f * x[i];
//   }
#ifdef EMULATED
#include "emulator/emulator.h"
#else

// A tensor as a kernel argument: its first element and how many there are.
template <class T>
struct Buffer {
    T* data;
    long long size;
    T& operator[](long long i) const { return data[i]; }
};

// A kernel for blocks of up to so many threads and, as a second number, with so many blocks per multiprocessor.
#define KERNEL(...) extern "C" __global__ void __launch_bounds__(__VA_ARGS__)

// Shared memory of a block, uninitialised.
#define SHARED(T, name, count) __shared__ T name[count]
template <class T>
using SharedArray = T*;

#endif

constexpr unsigned kAllLanes = 0xffffffffu;

// Sum over a warp, the same bits in all of its lanes.
template <class T>
inline T warp_sum(T value) {
#pragma unroll
    for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
    return value;
}
