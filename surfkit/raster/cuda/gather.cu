// Per splat: its gradient, from the sums over its pixels.
#include "view.h"

using namespace surfkit;

// The gradients of the splats `index` from the rows of sums in their slots, added up in the order of the slots.
KERNEL(128)
gather(Buffer<const float> means, Buffer<const float> quats, Buffer<const float> scales, Buffer<const float> opacities,
       Buffer<const float> sh0, Buffer<const float> sh_rest, View view, Buffer<const SplatTint> tints,
       Buffer<const long long> index, Buffer<const int> first, Buffer<const float> sums,
       Buffer<const unsigned char> touched, long long rows,
       Buffer<float> d_means, Buffer<float> d_quats, Buffer<float> d_scales, Buffer<float> d_opacities,
       Buffer<float> d_sh0, Buffer<float> d_sh_rest, Buffer<float> signal, Buffer<float> chosen) {
    const long long r = blockIdx.x * 128LL + threadIdx.x;
    if (r >= index.size || index[r] >= rows) return;
    constexpr int color_at = Splat::sums - 4, chosen_at = Splat::sums;
    Pair s[WIDTH] = {};
    bool is_hit = false;
    for (int slot = first[r]; slot < first[r + 1]; slot++) {
        if (!touched[slot]) continue;
        is_hit = true;
        for (int k = 0; k < WIDTH; k++) s[k] += sums[(long long)slot * WIDTH + k];
    }
    if (!is_hit) return;
    const Arrays splats = {means, quats, scales, opacities, sh0, sh_rest};
    const long long i = index[r];
    const SplatIn<Pair> in = read_splat(splats, i, kColumns);
    const SplatGrad<Pair> g = splat_backward(kKind, in, view.camera, view.form, s);
    const Sight seen = sight(view, in);
    SplatTint shown;
    if (kKeepsTints) {
        shown = tints[r];
    } else {
        float rgb[3];
        shade(splats, i, seen, rgb);
        shown = tint(splats, i, seen, rgb);
    }
    Vec<float> mean = rounded(g.mean);
    for (int c = 0; c < 3; c++) {
        const float by_channel = shown.is_lit[c] ? (float)s[color_at + c] : 0.0f;
        mean = mean + by_channel * shown.by_mean[c];
        d_sh0[3 * i + c] = by_channel * seen.basis[0];
        for (int k = 1; k < COEFFICIENTS; k++)
            d_sh_rest[3 * ((COEFFICIENTS - 1) * i + k - 1) + c] = by_channel * seen.basis[k];
    }
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
