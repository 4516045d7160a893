// A number of about 47 bits as the sum of two floats: doubles take a GPU of the RTX series 64 times as long as floats.
//
// Products and sums are error-free transformations (Dekker 1971, Knuth's two-sum, products by fma), so that a Pair stands
// in for double as the number type of ../splat_math.h: that far more cancels than a float can lose is the rule there
// (determinants, conics, a large scene's coordinates). Its range is that of float. The intrinsics are never contracted:
// a product that is joined with a sum would no longer be the one whose error is known.
#pragma once

struct Pair {
    float high, low;  // low is at most a few units in the last place of high

    Pair() = default;
    constexpr Pair(float x) : high(x), low(0) {}
    constexpr Pair(int x) : high((float)x), low((float)(x - (int)(float)x)) {}
    constexpr Pair(double x) : high((float)x), low((float)(x - (double)(float)x)) {}  // of constants alone
    constexpr Pair(float h, float l) : high(h), low(l) {}
    explicit operator float() const { return high + low; }
};

// high + low exactly, where low is the smaller one.
inline Pair normalized(float high, float low) {
    const float sum = __fadd_rn(high, low);
    return {sum, __fsub_rn(low, __fsub_rn(sum, high))};
}
inline Pair operator-(Pair a) { return {-a.high, -a.low}; }
inline Pair operator+(Pair a, Pair b) {
    const float sum = __fadd_rn(a.high, b.high), part = __fsub_rn(sum, a.high);
    const float error = __fadd_rn(__fsub_rn(a.high, __fsub_rn(sum, part)), __fsub_rn(b.high, part));
    return normalized(sum, __fadd_rn(error, __fadd_rn(a.low, b.low)));
}
inline Pair operator-(Pair a, Pair b) {
    const float sum = __fsub_rn(a.high, b.high), part = __fsub_rn(sum, a.high);
    const float error = __fsub_rn(__fsub_rn(a.high, __fsub_rn(sum, part)), __fadd_rn(b.high, part));
    return normalized(sum, __fadd_rn(error, __fsub_rn(a.low, b.low)));
}
inline Pair operator*(Pair a, Pair b) {
    const float product = __fmul_rn(a.high, b.high);
    return {product, fmaf(a.high, b.low, fmaf(a.low, b.high, fmaf(a.high, b.high, -product)))};
}
inline Pair operator*(float a, Pair b) {
    const float product = __fmul_rn(a, b.high);
    return {product, fmaf(a, b.low, fmaf(a, b.high, -product))};
}
inline Pair operator*(int a, Pair b) { return (float)a * b; }
inline Pair operator/(Pair a, Pair b) {
    const float inverse = 1 / b.high, ratio = __fmul_rn(a.high, inverse);
    const float rest = __fadd_rn(fmaf(-ratio, b.high, a.high), fmaf(-ratio, b.low, a.low));
    return normalized(ratio, __fmul_rn(rest, inverse));
}
inline Pair& operator+=(Pair& a, Pair b) { return a = a + b; }
inline Pair& operator-=(Pair& a, Pair b) { return a = a - b; }
inline Pair& operator*=(Pair& a, Pair b) { return a = a * b; }
inline bool operator<(Pair a, Pair b) { return a.high < b.high || (a.high == b.high && a.low < b.low); }
inline bool operator>(Pair a, Pair b) { return b < a; }
inline bool operator!=(Pair a, Pair b) { return a.high != b.high || a.low != b.low; }

inline float rough(Pair x) { return (float)x; }

inline Pair square_root(Pair x) {
    const float root = sqrtf(x.high);
    if (!(root > 0)) return root;
    return normalized(root, __fmul_rn(__fadd_rn(fmaf(-root, root, x.high), x.low), 0.5f / root));
}
inline Pair round_down(Pair x) {
    const float whole = floorf(x.high);
    return whole == x.high ? normalized(whole, floorf(x.low)) : Pair(whole);
}
