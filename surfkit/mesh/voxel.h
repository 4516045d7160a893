// What a view does to one voxel, and which blocks a pixel reaches, once for the CPU (in loops over a layer of a block)
// and for GPUs (a thread for each voxel). Plain scalars without includes or branches. No compiler may join a product
// and a sum into one rounding, so every machine gives the same bits; reference.py is the definition of correct.
#pragma once

namespace surfkit {

constexpr int kSide = 8;  // voxels
constexpr int kVoxels = kSide * kSide * kSide;
constexpr int kBlockBits = 17;
constexpr int kBlockBias = 1 << (kBlockBits - 1);  // blocks along each axis, to either side of the origin
constexpr float kSteps = 32767.0f, kMostWeight = 65535.0f;
constexpr float kMostColorWeight = 2048.0f;  // 64 views: colours go on following later ones

// A picture: depth and shade of a pixel lie at row * width + column.
struct Lens {
    int width, height;
    float fx, fy, cx, cy;
};

// Lengths in units of the world; fade: depth behind the surface at which the weight begins to fall.
struct Band {
    float truncation, jump, fade;
};

// Where a voxel falls in the picture: its pixel, and the four whose centres are around it.
struct Place {
    float z, at_x, at_y;  // at: from the left to the right, and from the upper to the lower
    int inside, pixel, left, right, above, below;
};

inline Place place(const Lens& lens, float x, float y, float z) {
    const float turn = 1.0f / z;
    const float u = x * turn * lens.fx + lens.cx;
    const float v = y * turn * lens.fy + lens.cy;
    const int inside = (z > 0) & (u >= 0) & (u < (float)lens.width) & (v >= 0) & (v < (float)lens.height);
    const float px = inside ? u : 0.0f, py = inside ? v : 0.0f;
    const int left = (int)(px + 0.5f) - 1, above = (int)(py + 0.5f) - 1;
    Place p;
    p.z = z;
    p.inside = inside;
    p.pixel = (int)py * lens.width + (int)px;
    p.at_x = px - 0.5f - (float)left;
    p.at_y = py - 0.5f - (float)above;
    p.left = left < 0 ? 0 : left;
    p.right = left + 1 < lens.width ? left + 1 : lens.width - 1;
    p.above = (above < 0 ? 0 : above) * lens.width;
    p.below = (above + 1 < lens.height ? above + 1 : lens.height - 1) * lens.width;
    return p;
}

// Whether a voxel that sees `depth` may lie before the end of the band, and whether in it. Interpolation changes the
// distance from the plane by no more than the jump, so it moves nothing that lies further in front of or behind the band.
// `slant`: distance from the plane of the pixel for each unit of depth.
inline int may_count(const Band& band, float depth, float z, float slant) {
    return (depth > 0 ? 1 : 0) & ((depth - z) * slant + band.jump > -band.truncation ? 1 : 0);
}
inline int may_be_near(const Band& band, float depth, float z, float slant) {
    return (depth - z) * slant - band.jump < band.truncation ? 1 : 0;
}

// The depth between four pixels; `own`, that of the nearest one, where they do not lie on one surface.
inline float between(const Band& band, float a, float b, float c, float d, float at_x, float at_y, float own,
                     float slant) {
    const float low_ab = a < b ? a : b, low_cd = c < d ? c : d, low = low_ab < low_cd ? low_ab : low_cd;
    const float top_ab = a > b ? a : b, top_cd = c > d ? c : d, top = top_ab > top_cd ? top_ab : top_cd;
    const float above = a + (b - a) * at_x, below = c + (d - c) * at_x;
    const float middle = above + (below - above) * at_y;
    const int smooth = (low > 0) & ((top - low) * slant <= band.jump) & (own > 0);
    return smooth ? middle : own;
}

// The weight that a view adds: that of its shade, less behind the surface, and none beyond the band.
inline float added_weight(const Band& band, int inside, float depth, float z, float slant, unsigned shade) {
    const float sdf = (depth - z) * slant;
    const float fall = (band.truncation + sdf) * (1.0f / (band.truncation - band.fade));
    const float trust = sdf < -band.fade ? fall : 1.0f;
    const int near = inside & (depth > 0) & (sdf > -band.truncation);
    return (float)(int)((float)(int)(shade >> 24) * (near ? trust : 0.0f) + 0.5f);
}

// The distance from the plane that a view sees, in 1/32767 of the truncation.
inline float seen_distance(const Band& band, float depth, float z, float slant) {
    const float scaled = (depth - z) * slant * (1.0f / band.truncation);
    return (scaled < 1.0f ? scaled : 1.0f) * kSteps;
}

// Shares of what is added in the new means, and the new weight.
struct Shares {
    float distance, color, weight;
};

inline Shares shares(float before, float added) {
    const float sum = before + added, sure = sum > 0 ? sum : 1.0f;
    Shares s;
    s.distance = added / sure;
    s.color = added / (sure < kMostColorWeight ? sure : kMostColorWeight);
    s.weight = sum < kMostWeight ? sum : kMostWeight;
    return s;
}

inline unsigned scrambled(unsigned x) {
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}

// Noise of a voxel of a block, for this weight: means are rounded up or down by it.
inline unsigned dither(unsigned seed, int voxel, float before) {
    return scrambled(seed + (unsigned)voxel * 0x9e3779b9u + (unsigned)before * 0x85ebca6bu);
}

inline int clamped(int x, int most) { return x < 0 ? 0 : x > most ? most : x; }

inline int mean_distance(float old, float seen, float share, unsigned noise) {
    const float mean = old + (seen - old) * share;
    const float random = (float)(int)(noise >> 16) * (1.0f / 65536);
    return clamped((int)(mean + 32768.0f + random), 65535) - 32768;
}

inline int mean_color(float old, unsigned shade, int channel, float share, unsigned noise) {
    const float seen = (float)(int)(shade >> (8 * channel) & 255u);
    const float random = (float)(int)(noise & 65535u) * (1.0f / 65536);
    return clamped((int)(old + (seen - old) * share + random), 255);
}

// The block that a coordinate, in blocks, lies in.
inline int block_of(double at) {
    const double most = kBlockBias - 1;
    return (int)((at < -most ? -most : at > most ? most : at) + kBlockBias) - kBlockBias;  // rounded down
}

typedef unsigned long long Key;  // of a block: its coordinates, z highest

inline Key packed(int x, int y, int z) {
    return (Key)(unsigned)(z + kBlockBias) << 2 * kBlockBits | (Key)(unsigned)(y + kBlockBias) << kBlockBits |
           (Key)(unsigned)(x + kBlockBias);
}
inline int part(Key key, int axis) { return (int)(key >> axis * kBlockBits & ((1u << kBlockBits) - 1)) - kBlockBias; }

inline Key mixed(Key x) {
    x ^= x >> 31;
    x *= 0x7fb5d329728ea185ull;
    x ^= x >> 27;
    x *= 0x81dadef4bc2dd44dull;
    return x ^ x >> 33;
}

}  // namespace surfkit
