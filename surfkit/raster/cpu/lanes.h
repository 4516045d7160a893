// Doubles of several splats at once, as a number type for the formulas of ../splat_math.h: each lane is rounded as a
// double is, so that all compilations give the same bits.
#pragma once

#include "../native/simd.h"

namespace {

constexpr int kWide = kLanes / 2;
typedef double WideDoubles __attribute__((vector_size(8 * kWide)));
typedef int64_t WideInts __attribute__((vector_size(8 * kWide)));

struct WideMask {
    WideInts m;
};
static inline WideMask operator&(WideMask a, WideMask b) { return {a.m & b.m}; }

struct Wide {
    WideDoubles v;
    Wide() = default;
    SURFKIT_INLINE Wide(double x) : v(WideDoubles{} + x) {}
    SURFKIT_INLINE explicit Wide(WideDoubles x) : v(x) {}
};
SURFKIT_INLINE static Wide operator+(Wide a, Wide b) { return Wide(a.v + b.v); }
SURFKIT_INLINE static Wide operator-(Wide a, Wide b) { return Wide(a.v - b.v); }
SURFKIT_INLINE static Wide operator*(Wide a, Wide b) { return Wide(a.v * b.v); }
SURFKIT_INLINE static Wide operator/(Wide a, Wide b) { return Wide(a.v / b.v); }
SURFKIT_INLINE static Wide& operator+=(Wide& a, Wide b) { return a = a + b; }
SURFKIT_INLINE static Wide operator-(Wide a) { return Wide(-a.v); }
SURFKIT_INLINE static WideMask operator<(Wide a, Wide b) { return {(WideInts)(a.v < b.v)}; }
SURFKIT_INLINE static WideMask operator>(Wide a, Wide b) { return {(WideInts)(a.v > b.v)}; }

SURFKIT_INLINE static Wide either(WideMask yes, Wide a, Wide b) {
    return Wide((WideDoubles)(((WideInts)a.v & yes.m) | ((WideInts)b.v & ~yes.m)));
}
SURFKIT_INLINE static Wide largest(Wide a, Wide b) { return either(a > b, a, b); }
SURFKIT_INLINE static Wide smallest(Wide a, Wide b) { return either(a < b, a, b); }
SURFKIT_INLINE static Wide magnitude(Wide a) { return either(a < Wide(0.0), -a, a); }
template <double (*f)(double)>
SURFKIT_INLINE static Wide of_each(Wide a) {
    for (int i = 0; i < kWide; i++) a.v[i] = f(a.v[i]);
    return a;
}
SURFKIT_INLINE static Wide square_root(Wide a) {
#if defined(__AVX512F__)
    return Wide((WideDoubles)_mm512_sqrt_pd((__m512d)a.v));
#elif defined(__AVX2__)
    return Wide((WideDoubles)_mm256_sqrt_pd((__m256d)a.v));
#else
    return of_each<std::sqrt>(a);
#endif
}
SURFKIT_INLINE static Wide round_down(Wide a) {
#if defined(__AVX512F__)
    return Wide((WideDoubles)_mm512_roundscale_pd((__m512d)a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC));
#elif defined(__AVX2__)
    return Wide((WideDoubles)_mm256_floor_pd((__m256d)a.v));
#else
    return of_each<std::floor>(a);
#endif
}
SURFKIT_INLINE static Wide rough(Wide a) { return a; }
SURFKIT_INLINE static Wide natural_log(Wide a) { return of_each<std::log>(a); }

// The first `count` lanes of a struct of numbers; `From` is the same of Wide as `To` of doubles.
template <class To, class From>
SURFKIT_INLINE void take_lanes(const From& from, int count, To* to) {
    static_assert(sizeof(From) == kWide * sizeof(To), "the same numbers");
    constexpr int numbers = sizeof(To) / sizeof(double);
    double all[numbers][kWide], one[numbers];
    std::memcpy(all, &from, sizeof from);
    for (int lane = 0; lane < count; lane++) {
        for (int i = 0; i < numbers; i++) one[i] = all[i][lane];
        std::memcpy(to + lane, one, sizeof one);
    }
}

}  // namespace
