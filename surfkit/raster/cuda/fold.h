// Sums of many numbers over a warp at once.
#pragma once

namespace surfkit {

// Adds to the lanes with a 0 in the bit `bit` of their number the first half of the values of those with a 1, and the
// other way round the second; and so on with the halves. Gives which of the values, whose sum is then v[0], is the
// lane's: `count` or more if none is.
template <int count, int bit = 16>
inline int fold(float* v, int lane) {
    constexpr int half = (count + 1) / 2;
    const bool is_upper = lane & bit;
#pragma unroll
    for (int i = 0; i < half; i++) {
        const float first = v[i], second = i + half < count ? v[i + half] : 0.0f;
        v[i] = (is_upper ? second : first) + __shfl_xor_sync(kAllLanes, is_upper ? first : second, bit);
    }
    int rest = 0;
    if constexpr (bit > 1) rest = fold<half, bit / 2>(v, lane);
    return is_upper ? half + rest : rest < half ? rest : count;
}

}  // namespace surfkit
