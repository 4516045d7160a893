// One step of Adam on a tensor and its moments, in one pass over them. The same arithmetic as raster/cpu/images.h.
//
// 28 bytes per value go through memory, 20 where moments are of 16 bits, and nothing else takes time: four values per
// thread, 256 apart, so that their loads are under way together whatever the tensors' alignment.

struct Numbers {
    float rate, share1, share2, correction, epsilon;
};

// Moments of 16 bits are the upper half of a float's (bfloat16); train/moments.py says how they are rounded.
inline float read(float x) { return x; }
inline float read(unsigned short x) { return __uint_as_float((unsigned)x << 16); }

inline float nearest(float, float x) { return x; }
inline unsigned short nearest(unsigned short, float x) {
    const unsigned bits = __float_as_uint(x);
    return (unsigned short)((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

inline float dithered(float, float x, long long, unsigned) { return x; }
inline unsigned short dithered(unsigned short, float x, long long at, unsigned step) {
    unsigned h = (unsigned)at * 0x9e3779b1u + step * 0x85ebca77u;
    h = (h ^ h >> 16) * 0x7feb352du;
    h = (h ^ h >> 15) * 0x846ca68bu;
    return (unsigned short)((__float_as_uint(x) + (h >> 16)) >> 16);
}

// where(i) is the place of value i of the gradient in the other tensors, which begin at `origin` of their column;
// kept(i) is what is left of its second moment before this step.
template <class Moment, class Where, class Kept>
inline void update(Buffer<float> value, Buffer<const float> gradient, Buffer<Moment> first, Buffer<Moment> second,
                   Numbers a, unsigned step, long long origin, Where where, Kept kept) {
    const long long start = blockIdx.x * 1024LL + threadIdx.x;
    float g[4], m[4], v[4], p[4];
    long long at[4];
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= gradient.size) continue;
        at[k] = where(i);
        g[k] = gradient[i];
        m[k] = read(Moment(first[at[k]]));
        v[k] = read(Moment(second[at[k]])) * kept(i);
        p[k] = value[at[k]];
    }
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= gradient.size) continue;
        m[k] = fmaf(g[k] - m[k], a.share1, m[k]);
        v[k] = fmaf(fmaf(g[k], g[k], -v[k]), a.share2, v[k]);
        first[at[k]] = nearest(Moment(0), m[k]);
        second[at[k]] = dithered(Moment(0), v[k], origin + at[k], step);
        value[at[k]] = p[k] - a.rate * m[k] / (sqrtf(v[k]) * a.correction + a.epsilon);
    }
}

#define ALL [](long long i) { return i; }, [](long long) { return 1.0f; }

KERNEL(256)
adam(Buffer<float> value, Buffer<const float> gradient, Buffer<float> first, Buffer<float> second,
     long long origin, float rate, float share1, float share2, float correction, float epsilon, unsigned step) {
    update<float>(value, gradient, first, second, {rate, share1, share2, correction, epsilon}, step, origin, ALL);
}

KERNEL(256)
adam_16(Buffer<float> value, Buffer<const float> gradient, Buffer<unsigned short> first, Buffer<unsigned short> second,
        long long origin, float rate, float share1, float share2, float correction, float epsilon, unsigned step) {
    const Numbers a = {rate, share1, share2, correction, epsilon};
    update<unsigned short>(value, gradient, first, second, a, step, origin, ALL);
}

// The same for some rows of a table, whose gradients and factors for the second moments lie one after the other.
#define ROWS [&](long long i) { return rows[i / wide] * wide + i % wide; }, [&](long long i) { return kept[i / wide]; }

KERNEL(256)
adam_rows(Buffer<float> value, Buffer<const long long> rows, Buffer<const float> kept, Buffer<const float> gradient,
          Buffer<float> first, Buffer<float> second, int wide, float rate, float share1, float share2, float correction,
          float epsilon, unsigned step) {
    update<float>(value, gradient, first, second, {rate, share1, share2, correction, epsilon}, step, 0, ROWS);
}

KERNEL(256)
adam_rows_16(Buffer<float> value, Buffer<const long long> rows, Buffer<const float> kept, Buffer<const float> gradient,
             Buffer<unsigned short> first, Buffer<unsigned short> second, int wide, float rate, float share1,
             float share2, float correction, float epsilon, unsigned step) {
    update<unsigned short>(value, gradient, first, second, {rate, share1, share2, correction, epsilon}, step, 0, ROWS);
}
