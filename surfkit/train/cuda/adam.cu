// One step of Adam on a tensor and its moments, in one pass over them. The same arithmetic as raster/cpu/images.h.
//
// 28 bytes per value go through memory and nothing else takes time: four values per thread, 256 apart, so that their
// loads are under way together whatever the tensors' alignment.

KERNEL(256)
adam(Buffer<float> value, Buffer<const float> gradient, Buffer<float> first, Buffer<float> second, float rate,
     float share1, float share2, float correction, float epsilon) {
    const long long start = blockIdx.x * 1024LL + threadIdx.x;
    float g[4], m[4], v[4], p[4];
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= value.size) continue;
        g[k] = gradient[i];
        m[k] = first[i];
        v[k] = second[i];
        p[k] = value[i];
    }
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= value.size) continue;
        m[k] = fmaf(g[k] - m[k], share1, m[k]);
        v[k] = fmaf(fmaf(g[k], g[k], -v[k]), share2, v[k]);
        first[i] = m[k];
        second[i] = v[k];
        value[i] = p[k] - rate * m[k] / (sqrtf(v[k]) * correction + epsilon);
    }
}

// The same for some rows of a table, whose gradients and factors for the second moments lie one after the other.
KERNEL(256)
adam_rows(Buffer<float> value, Buffer<const long long> rows, Buffer<const float> kept, Buffer<const float> gradient,
          Buffer<float> first, Buffer<float> second, int wide, float rate, float share1, float share2, float correction,
          float epsilon) {
    const long long start = blockIdx.x * 1024LL + threadIdx.x;
    float g[4], m[4], v[4], p[4];
    long long at[4];
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= gradient.size) continue;
        const long long row = i / wide;
        at[k] = rows[row] * wide + i % wide;
        g[k] = gradient[i];
        m[k] = first[at[k]];
        v[k] = second[at[k]] * kept[row];
        p[k] = value[at[k]];
    }
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const long long i = start + 256 * k;
        if (i >= gradient.size) continue;
        m[k] = fmaf(g[k] - m[k], share1, m[k]);
        v[k] = fmaf(fmaf(g[k], g[k], -v[k]), share2, v[k]);
        first[at[k]] = m[k];
        second[at[k]] = v[k];
        value[at[k]] = p[k] - rate * m[k] / (sqrtf(v[k]) * correction + epsilon);
    }
}
