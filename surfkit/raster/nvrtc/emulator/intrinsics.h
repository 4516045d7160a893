// CUDA's names for the emulator: qualifiers, vectors, arithmetic, and what warps and blocks do together.
#pragma once

#include <cfloat>

#include "memory.h"

static_assert(FLT_EVAL_METHOD == 0, "a float is rounded to a float at each step, as on a GPU");

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__ __attribute__((noinline))
#define __align__(n) alignas(n)
#define __restrict__
#define KERNEL(...) extern "C" void

// ---- vectors

#define EMULATOR_VECTORS(T, name, align2, align4)                      \
    struct alignas(align2) name##2 { T x, y; };                        \
    struct name##3 { T x, y, z; };                                     \
    struct alignas(align4) name##4 { T x, y, z, w; };                  \
    inline name##2 make_##name##2(T x, T y) { return {x, y}; }         \
    inline name##3 make_##name##3(T x, T y, T z) { return {x, y, z}; } \
    inline name##4 make_##name##4(T x, T y, T z, T w) { return {x, y, z, w}; }
EMULATOR_VECTORS(float, float, 8, 16)
EMULATOR_VECTORS(double, double, 16, 16)
EMULATOR_VECTORS(int, int, 8, 16)
struct alignas(8) uint2 {
    unsigned x, y;
};
struct alignas(16) uint4 {
    unsigned x, y, z, w;
};
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }

// ---- arithmetic

#define EMULATOR_EXTREMES(T)                         \
    inline T min(T a, T b) { return b < a ? b : a; } \
    inline T max(T a, T b) { return a < b ? b : a; }
EMULATOR_EXTREMES(int)
EMULATOR_EXTREMES(unsigned)
EMULATOR_EXTREMES(long long)
EMULATOR_EXTREMES(unsigned long long)
inline float min(float a, float b) { return fminf(a, b); }
inline float max(float a, float b) { return fmaxf(a, b); }
inline double min(double a, double b) { return fmin(a, b); }
inline double max(double a, double b) { return fmax(a, b); }

inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
inline double rsqrt(double x) { return 1.0 / sqrt(x); }
inline float emulated_exp(float x) { return expf(x); }
inline float emulated_log(float x) { return logf(x); }
inline float emulated_pow(float x, float y) { return powf(x, y); }
inline float emulated_sin(float x) { return sinf(x); }
inline float emulated_cos(float x) { return cosf(x); }
#define __expf emulated_exp  // glibc has its own names with two underscores
#define __logf emulated_log
#define __powf emulated_pow
#define __sinf emulated_sin
#define __cosf emulated_cos
inline float __fdividef(float a, float b) { return a / b; }
inline float __frcp_rn(float x) { return 1.0f / x; }
inline float __fsqrt_rn(float x) { return sqrtf(x); }
inline float __frsqrt_rn(float x) { return 1.0f / sqrtf(x); }
inline float __fmaf_rn(float a, float b, float c) { return fmaf(a, b, c); }
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fsub_rn(float a, float b) { return a - b; }
inline float __saturatef(float x) { return x > 0 ? (x < 1 ? x : 1.0f) : 0.0f; }

namespace emulator {
template <class To, class From>
inline To bits(From value) {
    static_assert(sizeof(To) == sizeof(From), "sizes differ");
    To out;
    std::memcpy(&out, &value, sizeof out);
    return out;
}
}  // namespace emulator
inline int __float_as_int(float x) { return emulator::bits<int>(x); }
inline unsigned __float_as_uint(float x) { return emulator::bits<unsigned>(x); }
inline float __int_as_float(int x) { return emulator::bits<float>(x); }
inline float __uint_as_float(unsigned x) { return emulator::bits<float>(x); }
inline int __float2int_rd(float x) { return (int)floorf(x); }
inline int __float2int_ru(float x) { return (int)ceilf(x); }
inline int __float2int_rn(float x) { return (int)rintf(x); }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __popcll(unsigned long long x) { return __builtin_popcountll(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __ffsll(long long x) { return __builtin_ffsll(x); }
inline int __clz(int x) { return x ? __builtin_clz(x) : 32; }
inline int __clzll(long long x) { return x ? __builtin_clzll(x) : 64; }
inline unsigned __brev(unsigned x) {
    unsigned out = 0;
    for (int i = 0; i < 32; i++) out |= (x >> i & 1) << (31 - i);
    return out;
}

// ---- barriers, votes, shuffles

namespace emulator {
inline constexpr Operation kSyncThreads = {"__syncthreads", Operation::kBarrier, nullptr};
inline constexpr Operation kSyncCount = {"__syncthreads_count", Operation::kBarrier, nullptr};
inline constexpr Operation kSyncAnd = {"__syncthreads_and", Operation::kBarrier, nullptr};
inline constexpr Operation kSyncOr = {"__syncthreads_or", Operation::kBarrier, nullptr};
inline constexpr Operation kSyncWarp = {"__syncwarp", Operation::kOrder, nullptr};
inline constexpr Operation kBallot = {"__ballot_sync", Operation::kVote, nullptr};
inline constexpr Operation kAny = {"__any_sync", Operation::kVote, nullptr};
inline constexpr Operation kAll = {"__all_sync", Operation::kVote, nullptr};
inline constexpr Operation kShfl = {"__shfl_sync", Operation::kShuffle, nullptr};
inline constexpr Operation kShflXor = {"__shfl_xor_sync", Operation::kShuffle, nullptr};
inline constexpr Operation kShflUp = {"__shfl_up_sync", Operation::kShuffle, nullptr};
inline constexpr Operation kShflDown = {"__shfl_down_sync", Operation::kShuffle, nullptr};

template <class T>
T shuffle(const Operation& operation, unsigned mask, T value, int lane, int line) {
    static_assert(sizeof(T) == 4 || sizeof(T) == 8, "shuffles take values of 4 or 8 bytes");
    uint64_t raw = 0;
    std::memcpy(&raw, &value, sizeof value);
    raw = meet(operation, mask, raw, lane, line);
    std::memcpy(&value, &raw, sizeof value);
    return value;
}
template <class T, T (*kCombine)(T, T)>
uint64_t combine(uint64_t a, uint64_t b) {
    return (uint64_t)kCombine((T)a, (T)b);
}
template <class T>
T added(T a, T b) {
    return a + b;
}
template <class T>
T ored(T a, T b) {
    return a | b;
}
template <class T>
T anded(T a, T b) {
    return a & b;
}
}  // namespace emulator

#define EMULATOR_LINE int line = __builtin_LINE()
inline void __syncthreads(EMULATOR_LINE) { emulator::barrier(emulator::kSyncThreads, 0, line); }
inline int __syncthreads_count(int p, EMULATOR_LINE) { return emulator::barrier(emulator::kSyncCount, p != 0, line); }
inline int __syncthreads_or(int p, EMULATOR_LINE) { return emulator::barrier(emulator::kSyncOr, p != 0, line) > 0; }
inline int __syncthreads_and(int p, EMULATOR_LINE) { return emulator::barrier(emulator::kSyncAnd, p == 0, line) == 0; }
inline void __syncwarp(unsigned mask = 0xffffffffu, EMULATOR_LINE) {
    emulator::meet(emulator::kSyncWarp, mask, 0, 0, line);
}
inline unsigned __ballot_sync(unsigned mask, int p, EMULATOR_LINE) {
    return (unsigned)emulator::meet(emulator::kBallot, mask, p != 0, 0, line);
}
inline int __any_sync(unsigned mask, int p, EMULATOR_LINE) {
    return emulator::meet(emulator::kAny, mask, p != 0, 0, line) != 0;
}
inline int __all_sync(unsigned mask, int p, EMULATOR_LINE) {
    return emulator::meet(emulator::kAll, mask, p != 0, 0, line) == mask;
}

// Source lanes as CUDA defines them: within a segment of `width` lanes, and the own value beyond it.
template <class T>
inline T __shfl_sync(unsigned mask, T value, int from, int width = 32, EMULATOR_LINE) {
    const int lane = emulator::machine.fiber->lane;
    return emulator::shuffle(emulator::kShfl, mask, value, (lane & ~(width - 1)) + (from & (width - 1)), line);
}
template <class T>
inline T __shfl_xor_sync(unsigned mask, T value, int flip, int width = 32, EMULATOR_LINE) {
    const int lane = emulator::machine.fiber->lane, other = lane ^ flip, end = (lane & ~(width - 1)) + width;
    return emulator::shuffle(emulator::kShflXor, mask, value, other < end ? other : lane, line);
}
template <class T>
inline T __shfl_up_sync(unsigned mask, T value, unsigned delta, int width = 32, EMULATOR_LINE) {
    const int lane = emulator::machine.fiber->lane, other = lane - (int)delta;
    return emulator::shuffle(emulator::kShflUp, mask, value, other >= (lane & ~(width - 1)) ? other : lane, line);
}
template <class T>
inline T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = 32, EMULATOR_LINE) {
    const int lane = emulator::machine.fiber->lane, other = lane + (int)delta, end = (lane & ~(width - 1)) + width;
    return emulator::shuffle(emulator::kShflDown, mask, value, other < end ? other : lane, line);
}

// From compute capability 8.0 on only: kernels for older ones use shuffles.
#define EMULATOR_REDUCE(T, suffix, function)                                                                     \
    inline T __reduce_##suffix##_sync(unsigned mask, T value, EMULATOR_LINE) {                                   \
        static const emulator::Operation operation = {"__reduce_" #suffix "_sync", emulator::Operation::kReduce, \
                                                      emulator::combine<T, function>};                           \
        return (T)emulator::meet(operation, mask, (uint64_t)value, 0, line);                                     \
    }
EMULATOR_REDUCE(int, add, emulator::added<int>)
EMULATOR_REDUCE(unsigned, add, emulator::added<unsigned>)
EMULATOR_REDUCE(int, min, min)
EMULATOR_REDUCE(unsigned, min, min)
EMULATOR_REDUCE(int, max, max)
EMULATOR_REDUCE(unsigned, max, max)
EMULATOR_REDUCE(unsigned, or, emulator::ored<unsigned>)
EMULATOR_REDUCE(unsigned, and, emulator::anded<unsigned>)

// ---- atomics: all give the value before

namespace emulator {
template <class T>
T exchanged(const Pointer<T>& p, T after) {
    T& at = p.change();
    const T before = at;
    at = after;
    return before;
}
template <class T>
T peek(const Pointer<T>& p) {
    return p.data[p.index];
}
template <class T>
struct Same {
    using type = T;
};
}  // namespace emulator
#define EMULATOR_ATOMIC(name, expression)                                                   \
    template <class T>                                                                      \
    inline T name(const emulator::Pointer<T>& at, typename emulator::Same<T>::type value) { \
        const T old = emulator::peek(at);                                                   \
        return emulator::exchanged<T>(at, (T)(expression));                                 \
    }
EMULATOR_ATOMIC(atomicAdd, old + value)
EMULATOR_ATOMIC(atomicSub, old - value)
EMULATOR_ATOMIC(atomicMax, old < value ? value : old)
EMULATOR_ATOMIC(atomicMin, value < old ? value : old)
EMULATOR_ATOMIC(atomicExch, value)
EMULATOR_ATOMIC(atomicOr, old | value)
EMULATOR_ATOMIC(atomicAnd, old& value)
EMULATOR_ATOMIC(atomicXor, old ^ value)
template <class T>
inline T atomicCAS(const emulator::Pointer<T>& at, typename emulator::Same<T>::type compare,
                   typename emulator::Same<T>::type value) {
    const T old = emulator::peek(at);
    return emulator::exchanged<T>(at, old == compare ? value : old);
}
