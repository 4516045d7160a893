// Per splat: its gradient, from the sums over its pixels.
#include "view.h"

using namespace surfkit;

// The gradients of the splats `index` from the rows of sums in their slots, added up in the order of the slots.
KERNEL(128)
gather(Buffer<const float> means, Buffer<const float> quats, Buffer<const float> scales, Buffer<const float> opacities,
       Buffer<const float> sh, View view, Buffer<const long long> index, Buffer<const long long> first,
       Buffer<const float> sums, Buffer<const unsigned char> touched, long long rows, Buffer<float> d_means,
       Buffer<float> d_quats, Buffer<float> d_scales, Buffer<float> d_opacities, Buffer<float> d_sh,
       Buffer<float> signal, Buffer<float> chosen) {
    const long long r = blockIdx.x * 128LL + threadIdx.x;
    if (r >= index.size || index[r] >= rows) return;
    constexpr int color_at = Splat::sums - 4, chosen_at = Splat::sums;
    Pair s[WIDTH] = {};
    bool is_hit = false;
    for (long long slot = first[r]; slot < first[r + 1]; slot++) {
        if (!touched[slot]) continue;
        is_hit = true;
        for (int k = 0; k < WIDTH; k++) s[k] += sums[slot * WIDTH + k];
    }
    if (!is_hit) return;
    const Arrays splats = {means, quats, scales, opacities, sh};
    const long long i = index[r];
    const SplatIn<Pair> in = read_splat(splats, i, kColumns);
    const SplatGrad<Pair> g = splat_backward(kKind, in, view.camera, view.form, s);
    const float color[3] = {(float)s[color_at], (float)s[color_at + 1], (float)s[color_at + 2]};
    const Shade<float> look = shade(splats, i, rounded(in.mean - view.camera.centre));
    const Vec<float> mean = rounded(g.mean) + shade_backward(splats, i, look, color, d_sh);
    d_means[3 * i] = mean.x;
    d_means[3 * i + 1] = mean.y;
    d_means[3 * i + 2] = mean.z;
    for (int k = 0; k < 4; k++) d_quats[4 * i + k] = (float)g.quat[k];
    for (int k = 0; k < kColumns; k++) d_scales[kColumns * i + k] = (float)g.scale[k];
    d_opacities[i] = (float)g.opacity;
    for (int k = 0; k < 2; k++) {
        signal[2 * i + k] = (float)g.signal[k];
        if (CHOSEN) chosen[2 * i + k] = (float)s[chosen_at + k];
    }
}
