// Per splat: what it touches and how it looks in a view.
//
// Both kernels must find the same tiles. So they call the same functions, and no product and sum is joined into one
// rounding but where fmaf says so (`is_exact` of the source): else the compiler could join others in each kernel.
#include "view.h"

using namespace surfkit;

namespace {

#if TILE_BYTES == 2
typedef short TileNumber;
#else
typedef int TileNumber;
#endif

// Projects a splat, and calls f(tile) for the tiles that it may touch; false if it is not drawn. `bound` is the exact
// one.
template <class F>
inline bool tiles_of(const View& view, const SplatIn<Pair>& in, SplatRecord& record, Bound<Pair>& bound, F f) {
    if (!project_one(in, view.camera, view.form, record, bound)) return false;
    fill_bound(record, widened(bound));
    const Reach about = reach(record, 0, 0);
    each_tile(about.bound, about.outline, record.ax, record.ay, view.tiles_x, view.tiles_y, view.rim, f);
    return true;
}

}  // namespace

// How many tiles each splat touches, its depth and its radius in pixels; all 0 where it is not drawn. `invalid` keeps
// the first row with a value that is not finite or not positive.
KERNEL(128, 4)
measure(Buffer<const float> means, Buffer<const float> quats, Buffer<const float> scales, Buffer<const float> opacities,
        View view, Buffer<int> tiles, Buffer<float> depth, Buffer<float> radii, Buffer<long long> invalid) {
    const long long i = blockIdx.x * 128LL + threadIdx.x;
    if (i >= tiles.size) return;
    const Arrays splats = {means, quats, scales, opacities, {}, {}};
    const SplatIn<Pair> in = read_splat(splats, i, kColumns);
    int count = 0;
    float z = 0, radius = 0;
    if (!valid(in, kColumns)) {
        atomicMin(&invalid[0], i);
    } else {
        const Vec<Pair> centre = splat::mul(view.camera.turn, in.mean) + view.camera.shift;
        SplatRecord record;
        Bound<Pair> bound;
        if (!view.outlook.misses(kKind, (float)largest_scale(in), rounded(centre)) &&
            tiles_of(view, in, record, bound, [&](int) { count++; })) {
            z = (float)centre.z;
            if (count)
                radius = square_root((float)splat::largest(bound.hxx, splat::largest(bound.hyy, bound.r2)));
        }
    }
    tiles[i] = count;
    depth[i] = z;
    radii[i] = radius;
}

// The records of the splats `index`, in this order, and the tiles that they touch: those of record r from slot first[r]
// on.
KERNEL(128)
record(Buffer<const float> means, Buffer<const float> quats, Buffer<const float> scales, Buffer<const float> opacities,
       Buffer<const float> sh0, Buffer<const float> sh_rest, View view, Buffer<const long long> index,
       Buffer<const int> first, Buffer<SplatRecord> records, Buffer<SplatTint> tints, Buffer<TileNumber> tile_of,
       Buffer<int> record_of) {
    const long long r = blockIdx.x * 128LL + threadIdx.x;
    if (r >= index.size) return;
    const Arrays splats = {means, quats, scales, opacities, sh0, sh_rest};
    const long long i = index[r];
    const SplatIn<Pair> in = read_splat(splats, i, kColumns);
    SplatRecord o;
    Bound<Pair> bound;
    int slot = first[r];
    tiles_of(view, in, o, bound, [&](int tile) {
        tile_of[slot] = (TileNumber)tile;
        record_of[slot] = (int)r;
        slot++;
    });
    const Sight seen = sight(view, in);
    float rgb[3];
    shade(splats, i, seen, rgb);
    // NaN stays, so that the picture shows it: to ask for it here would wait for the device.
    for (int c = 0; c < 3; c++) o.color[c] = rgb[c] < 0 ? 0.0f : rgb[c];
    records[r] = o;
    if (kKeepsTints) tints[r] = tint(splats, i, seen, rgb);
}

// The list of all tiles, in the order of their sorted slots.
KERNEL(128) list(Buffer<const long long> slots, Buffer<const int> record_of, Buffer<Entry> entries) {
    const long long k = blockIdx.x * 128LL + threadIdx.x;
    if (k >= slots.size) return;
    const int slot = (int)slots[k];
    entries[k] = {record_of[slot], slot};
}
