// The arithmetic of pairs of floats, each element for itself.
#include "../../../../surfkit/raster/cuda/pair.h"

inline Pair pair(float2 v) { return {v.x, v.y}; }
inline float2 parts(Pair v) { return make_float2(v.high, v.low); }

KERNEL(128)
arithmetic(Buffer<const float2> a, Buffer<const float2> b, Buffer<float2> sum, Buffer<float2> difference,
           Buffer<float2> product, Buffer<float2> ratio, Buffer<float2> root, Buffer<float2> whole) {
    const int i = threadIdx.x;
    if (i >= a.size) return;
    const Pair x = pair(float2(a[i])), y = pair(float2(b[i]));
    sum[i] = parts(x + y);
    difference[i] = parts(x - y);
    product[i] = parts(x * y);
    ratio[i] = parts(x / y);
    root[i] = parts(square_root(x * x));
    whole[i] = parts(round_down(x));
}
