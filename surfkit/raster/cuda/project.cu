// Per splat: what it touches and how it looks in a view.
#include "view.h"

using namespace surfkit;

// How many tiles each splat touches, its depth and its radius in pixels; all 0 where it is not drawn. `invalid` keeps
// the first row with a value that is not finite or not positive.
KERNEL(128, 4)
measure(Buffer<const float> means, Buffer<const float> quats, Buffer<const float> scales, Buffer<const float> opacities,
        View view, Buffer<int> tiles, Buffer<float> depth, Buffer<float> radii, Buffer<long long> invalid) {
    const long long i = blockIdx.x * 128LL + threadIdx.x;
    if (i >= tiles.size) return;
    const Arrays splats = {means, quats, scales, opacities, opacities};
    const SplatIn<double> in = read_splat(splats, i, kColumns);
    int count = 0;
    float z = 0, radius = 0;
    if (!valid(in, kColumns)) {
        atomicMin(&invalid[0], i);
    } else {
        const Vec<double> centre = splat::mul(view.camera.turn, in.mean) + view.camera.shift;
        SplatRecord record;
        Bound<double> bound;
        if (!Outlook(view.camera).misses(kKind, in, centre) && project_one(in, view.camera, view.form, record, bound)) {
            each_tile(widened(bound), view.tiles_x, view.tiles_y, view.rim, [&](int) { count++; });
            z = (float)centre.z;
            if (count) radius = (float)square_root(splat::largest(bound.hxx, splat::largest(bound.hyy, bound.r2)));
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
       Buffer<const float> sh, View view, Buffer<const long long> index, Buffer<const long long> first,
       Buffer<SplatRecord> records, Buffer<int> tile_of, Buffer<int> record_of) {
    const long long r = blockIdx.x * 128LL + threadIdx.x;
    if (r >= index.size) return;
    const Arrays splats = {means, quats, scales, opacities, sh};
    const long long i = index[r];
    const SplatIn<double> in = read_splat(splats, i, kColumns);
    SplatRecord o;
    Bound<double> bound;
    project_one(in, view.camera, view.form, o, bound);
    bound = widened(bound);
    fill_bound(o, bound);
    const Shade look = shade(splats, i, in, view.camera);
    // NaN stays, so that the picture shows it: to ask for it here would wait for the device.
    for (int c = 0; c < 3; c++) o.color[c] = (float)(look.rgb[c] < 0 ? 0.0 : look.rgb[c]);
    records[r] = o;
    long long slot = first[r];
    each_tile(bound, view.tiles_x, view.tiles_y, view.rim, [&](int tile) {
        tile_of[slot] = tile;
        record_of[slot] = (int)r;
        slot++;
    });
}
