// Vectors of kLanes floats for the instruction set this file is compiled for: AVX-512, AVX2 with FMA, or the baseline
// (SSE2, NEON). Everything is in an unnamed namespace, so that the three compilations never share a symbol.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__AVX2__) || defined(__AVX512F__)
#include <immintrin.h>
#endif

// For what must not become a call: vectors would pass through memory, and GCC drops calls that do nothing but prefetch.
#define SURFKIT_INLINE __attribute__((always_inline)) inline

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef int32_t Ints __attribute__((vector_size(4 * kLanes)));

// Not as a sum with zero, which is computed, as it makes 0 of -0.
static inline Floats broadcast(float x) {
#if defined(__AVX512F__)
    return (Floats)_mm512_set1_ps(x);
#elif defined(__AVX2__)
    return (Floats)_mm256_set1_ps(x);
#else
    return Floats{x, x, x, x};
#endif
}
static inline Floats load(const float* p) {
    Floats v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
static inline void store(float* p, Floats v) { std::memcpy(p, &v, sizeof v); }

#if defined(__AVX512F__)

struct Mask {
    __mmask16 m;
};
static inline Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.m & b.m)}; }
static inline Mask without(Mask a, Mask b) { return {(__mmask16)(a.m & ~b.m)}; }
static inline bool any(Mask a) { return a.m != 0; }
static inline uint32_t bits(Mask a) { return a.m; }
static inline Mask all_lanes() { return {0xffff}; }
static inline Mask lesser(Floats a, Floats b) { return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ)}; }
static inline Mask less_equal(Floats a, Floats b) { return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ)}; }
static inline Mask less_equal(Ints a, Ints b) { return {_mm512_cmple_epi32_mask((__m512i)a, (__m512i)b)}; }
static inline Mask equal(Ints a, Ints b) { return {_mm512_cmpeq_epi32_mask((__m512i)a, (__m512i)b)}; }
static inline Floats select(Mask m, Floats a, Floats b) {
    return (Floats)_mm512_mask_blend_ps(m.m, (__m512)b, (__m512)a);
}
static inline Ints select(Mask m, Ints a, Ints b) { return (Ints)_mm512_mask_blend_epi32(m.m, (__m512i)b, (__m512i)a); }
static inline Floats keep(Mask m, Floats a) { return (Floats)_mm512_maskz_mov_ps(m.m, (__m512)a); }
static inline Floats madd(Floats a, Floats b, Floats c) {
    return (Floats)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
}
static inline Floats root(Floats a) { return (Floats)_mm512_sqrt_ps((__m512)a); }
static inline Floats rough_root(Floats a) {  // within 1e-4, a > 0
    return a * (Floats)_mm512_rsqrt14_ps((__m512)a);
}
static inline Floats lower(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
static inline Floats higher(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
static inline Floats reciprocal(Floats a) {  // one Newton step on the 14-bit estimate: within 1 ulp
    const __m512 r = _mm512_rcp14_ps((__m512)a);
    return (Floats)_mm512_fmadd_ps(_mm512_fnmadd_ps((__m512)a, r, _mm512_set1_ps(1.0f)), r, r);
}

#else

struct Mask {
    Ints m;
};
static inline Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
static inline Mask without(Mask a, Mask b) { return {a.m & ~b.m}; }
static inline uint32_t bits(Mask a) {
#if defined(__AVX2__)
    return (uint32_t)_mm256_movemask_ps((__m256)a.m);
#else
    uint32_t r = 0;
    for (int i = 0; i < kLanes; i++) r |= (a.m[i] & 1u) << i;
    return r;
#endif
}
static inline bool any(Mask a) { return bits(a) != 0; }
static inline Mask all_lanes() { return {~Ints{}}; }
static inline Mask lesser(Floats a, Floats b) { return {(Ints)(a < b)}; }
static inline Mask less_equal(Floats a, Floats b) { return {(Ints)(a <= b)}; }
static inline Mask less_equal(Ints a, Ints b) { return {(Ints)(a <= b)}; }
static inline Mask equal(Ints a, Ints b) { return {(Ints)(a == b)}; }
static inline Ints select(Mask m, Ints a, Ints b) { return (a & m.m) | (b & ~m.m); }
static inline Floats select(Mask m, Floats a, Floats b) { return (Floats)select(m, (Ints)a, (Ints)b); }
static inline Floats keep(Mask m, Floats a) { return (Floats)((Ints)a & m.m); }
static inline Floats lower(Floats a, Floats b) { return select(lesser(a, b), a, b); }
static inline Floats higher(Floats a, Floats b) { return select(lesser(b, a), a, b); }
#if defined(__AVX2__)
static inline Floats madd(Floats a, Floats b, Floats c) {
    return (Floats)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
}
static inline Floats root(Floats a) { return (Floats)_mm256_sqrt_ps((__m256)a); }
#else
static inline Floats madd(Floats a, Floats b, Floats c) { return a * b + c; }
static inline Floats root(Floats a) {
    Floats r{};
    for (int i = 0; i < kLanes; i++) r[i] = std::sqrt(a[i]);
    return r;
}
#endif
static inline Floats reciprocal(Floats a) { return 1.0f / a; }
static inline Floats rough_root(Floats a) { return root(a); }

#endif

static inline Mask less_equal(float a, Floats b) { return less_equal(broadcast(a), b); }
static inline Mask less_equal(Floats a, float b) { return less_equal(a, broadcast(b)); }
static inline Mask lesser(float a, Floats b) { return lesser(broadcast(a), b); }
static inline Mask lesser(Floats a, float b) { return lesser(a, broadcast(b)); }
static inline Floats select(Mask m, Floats a, float b) { return select(m, a, broadcast(b)); }
static inline Floats select(Mask m, float a, float b) { return select(m, broadcast(a), broadcast(b)); }
static inline Floats madd(Floats a, float b, Floats c) { return madd(a, broadcast(b), c); }
static inline Floats madd(Floats a, float b, float c) { return madd(a, broadcast(b), broadcast(c)); }

// e^x for x <= 0, within 4e-7 of the true value relatively; about 0 below -87.
static inline Floats exp_negative(Floats x) {
#if !defined(__AVX512F__)
    x = higher(x, broadcast(-87.0f));
#endif
    const float log2_e = 1.44269504f;
#if defined(__AVX512F__)
    const Floats n = (Floats)_mm512_roundscale_ps((__m512)(x * log2_e), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
    const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
    const Floats t = madd(x, log2_e, magic), n = t - magic;
#endif
    const Floats f = madd(x, log2_e, -n);
    Floats p = broadcast(1.5403530e-4f);  // 2^f on [-1/2, 1/2]
    p = madd(p, f, broadcast(1.3333558e-3f));
    p = madd(p, f, broadcast(9.6181291e-3f));
    p = madd(p, f, broadcast(5.5504109e-2f));
    p = madd(p, f, broadcast(2.4022651e-1f));
    p = madd(p, f, broadcast(6.9314718e-1f));
    p = madd(p, f, broadcast(1.0f));
#if defined(__AVX512F__)
    return (Floats)_mm512_scalef_ps((__m512)p, (__m512)n);
#else
    Ints shift, out;
    std::memcpy(&shift, &t, sizeof shift);
    std::memcpy(&out, &p, sizeof out);
    out += (shift - 0x4B400000) << 23;
    std::memcpy(&p, &out, sizeof p);
    return p;
#endif
}

// ln x for x > 0, within 1e-6 absolutely for x in [1e-6, 1].
static inline Floats log_positive(Floats x) {
    Ints i;
    std::memcpy(&i, &x, sizeof i);
    const Ints e = ((i - 0x3f3504f3) >> 23);  // so that the mantissa lies in [1/sqrt 2, sqrt 2)
    i -= e << 23;
    Floats m;
    std::memcpy(&m, &i, sizeof m);
    const Floats f = m - 1.0f;
    Floats p = broadcast(7.0376836292e-2f);
    p = madd(p, f, broadcast(-1.1514610310e-1f));
    p = madd(p, f, broadcast(1.1676998740e-1f));
    p = madd(p, f, broadcast(-1.2420140846e-1f));
    p = madd(p, f, broadcast(1.4249322787e-1f));
    p = madd(p, f, broadcast(-1.6668057665e-1f));
    p = madd(p, f, broadcast(2.0000714765e-1f));
    p = madd(p, f, broadcast(-2.4999993993e-1f));
    p = madd(p, f, broadcast(3.3333331174e-1f));
    const Floats ff = f * f;
    Floats y = p * f * ff;
    const Floats n = __builtin_convertvector(e, Floats);
    y = madd(n, -2.12194440e-4f, y);
    y = y - 0.5f * ff;
    return madd(n, 0.693359375f, f + y);
}

static inline Floats magnitude(Floats a) { return (Floats)((Ints)a & 0x7fffffff); }

#if defined(__AVX2__) || defined(__AVX512F__)
// Sums of the lanes of four vectors. The order of each sum is fixed.
SURFKIT_INLINE __m128 sum_four(const Floats* v) {
    __m128 q[4];
    for (int j = 0; j < 4; j++) {
#if defined(__AVX512F__)
        const __m256 h = _mm256_add_ps(_mm512_castps512_ps256((__m512)v[j]), _mm512_extractf32x8_ps((__m512)v[j], 1));
#else
        const __m256 h = (__m256)v[j];
#endif
        q[j] = _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1));
    }
    return _mm_hadd_ps(_mm_hadd_ps(q[0], q[1]), _mm_hadd_ps(q[2], q[3]));
}
#endif

// Sum of the lanes of `count` vectors into out[0 .. count), count a multiple of 4.
SURFKIT_INLINE void sum_lanes(const Floats* v, int count, float* out) {
#if defined(__AVX2__) || defined(__AVX512F__)
    for (int i = 0; i < count; i += 4) _mm_storeu_ps(out + i, sum_four(v + i));
#else
    for (int i = 0; i < count; i++) out[i] = (v[i][0] + v[i][1]) + (v[i][2] + v[i][3]);
#endif
}

// Sums of the lanes of `count` vectors, kLanes at most, which are followed by zeros up to a multiple of 4, in one register:
// what is stored in parts and loaded as a whole waits for the stores.
SURFKIT_INLINE Floats sum_each(const Floats* v, int count) {
#if defined(__AVX512F__)
    __m512 out = _mm512_castps128_ps512(sum_four(v));
    out = _mm512_insertf32x4(out, count > 4 ? sum_four(v + 4) : _mm_setzero_ps(), 1);
    if (count > 8) out = _mm512_insertf32x4(out, sum_four(v + 8), 2);
    if (count > 12) out = _mm512_insertf32x4(out, sum_four(v + 12), 3);
    return (Floats)out;
#elif defined(__AVX2__)
    return (Floats)_mm256_insertf128_ps(
        _mm256_castps128_ps256(sum_four(v)), count > 4 ? sum_four(v + 4) : _mm_setzero_ps(), 1);
#else
    Floats out{};
    for (int i = 0; i < kLanes; i++) out[i] = (v[i][0] + v[i][1]) + (v[i][2] + v[i][3]);
    return out;
#endif
}

}  // namespace
