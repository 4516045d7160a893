#include "pass.h"

#include <algorithm>
#include <cstring>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "../native/pool.h"

namespace surfkit {
namespace {

constexpr int64_t kChunk = 512;  // splats projected as one piece of work
constexpr int64_t kGroup = 32;   // of these, splats whose values stay in the fastest cache

int64_t chunks_of(int64_t count, int64_t size) { return (count + size - 1) / size; }

// Stable order of `keys` (non-negative floats), as positions; least significant digit first.
std::vector<uint32_t> order_of(const std::vector<float>& keys) {
    const size_t n = keys.size();
    if (!n) return {};
    std::vector<uint32_t> bits(n), order(n), bits2(n), order2(n);
    std::memcpy(bits.data(), keys.data(), n * sizeof(float));
    for (size_t i = 0; i < n; i++) order[i] = (uint32_t)i;
    for (int shift = 0; shift < 32; shift += 11) {
        uint32_t start[2049] = {};
        for (size_t i = 0; i < n; i++) start[((bits[i] >> shift) & 2047) + 1]++;
        for (int d = 0; d < 2048; d++) start[d + 1] += start[d];
        for (size_t i = 0; i < n; i++) {
            const uint32_t at = start[(bits[i] >> shift) & 2047]++;
            bits2[at] = bits[i];
            order2[at] = order[i];
        }
        bits.swap(bits2);
        order.swap(order2);
    }
    return order;
}

// Rows of the splats of a chunk that may touch a pixel; their number. The first that is not valid is told.
int64_t may_touch(Kind kind, const SplatArrays& splats, int64_t from, const Outlook<double>& outlook, int64_t* rows,
                  int64_t& invalid, bool* seen, float* radii) {
    const int columns = scale_columns(kind);
    int64_t count = 0;
    for (int64_t i = from; i < std::min(splats.count, from + kChunk); i++) {
        seen[i] = false;
        radii[i] = 0;
        const SplatIn<double> in = read_splat(splats, i, columns);
        if (!valid(in, columns)) {
            if (invalid < 0) invalid = i;
        } else if (!outlook.misses(kind, largest_scale(in), splat::mul(outlook.cam.turn, in.mean) + outlook.cam.shift)) {
            rows[count++] = i;
        }
    }
    return count;
}

// Keeps those of some tiles that are in a strip; their number.
int inside(Strip strip, int tiles_x, uint32_t* tiles, int count) {
    const int64_t first = (int64_t)strip.first * tiles_x, end = (int64_t)strip.end * tiles_x;
    return (int)(std::remove_if(tiles, tiles + count, [&](uint32_t t) { return t < first || t >= end; }) - tiles);
}

template <class Record>
void project_some(const SplatArrays& splats, const int64_t* rows, int64_t count, const CameraModel<double>& camera,
                  const GaussianForm& form, Record* records, Bound<double>* bounds, bool* drawn) {
    for (int64_t k = 0; k < count; k++)
        drawn[k] = project_one(read_splat(splats, rows[k], 3), camera, form, records[k], bounds[k]);
}

void project_some(const SplatArrays& splats, const int64_t* rows, int64_t count, const CameraModel<double>& camera,
                  const GaussianForm&, SurfelRecord* records, Bound<double>* bounds, bool* drawn) {
    splat::SurfelView<double> views[kGroup];
    kernels().project_surfels(splats, rows, count, camera, views, drawn);
    for (int64_t k = 0; k < count; k++) {
        if (!drawn[k]) continue;
        fill_record(records[k], splats.opacities[rows[k]], views[k]);
        bounds[k] = views[k].bound;
    }
}

}  // namespace

template <class F>
void Pass::each_seen(int threads, F f) const {
    parallel((int64_t)seen_in_.size(), threads, [&](int64_t c) {
        for (int64_t r = c * kChunk; r < c * kChunk + seen_in_[c]; r++) f(r);
    });
}

Pass::Pass(Kind kind, const SplatArrays& splats, const CameraModel<double>& camera, const GaussianForm& form,
           double rim, int threads, bool* seen, float* radii, Strip strip)
    : kind_(kind),
      camera_(camera),
      form_(form),
      rim_(rim),
      strip_(strip),
      count_(splats.count),
      tiles_x_((camera.width + kTile - 1) / kTile),
      tiles_y_((camera.height + kTile - 1) / kTile) {
    if (kind == kSurfel) project<SurfelRecord>(splats, threads, seen, radii);
    if (kind == kGaussian) project<GaussianRecord>(splats, threads, seen, radii);
    if (kind == kGaussianRay) project<RayRecord>(splats, threads, seen, radii);
    if (first_invalid < 0) bin(threads);
}

template <class Record>
void Pass::project(const SplatArrays& splats, int threads, bool* seen, float* radii) {
    const int64_t n = splats.count, chunks = chunks_of(n, kChunk);
    records_ = buffer<char>(n * sizeof(Record));
    tiles_of_.assign(chunks, {});
    index_ = buffer<int64_t>(n);
    depth_ = buffer<float>(n);
    slot_ = buffer<uint32_t>(n);
    tiles_ = buffer<uint32_t>(n);
    seen_in_.assign(chunks, 0);
    Record* records = (Record*)records_.get();
    std::vector<int64_t> invalid(chunks, -1);
    const Outlook<double> outlook(camera_);
    const Kernels& kernel = kernels();
    parallel(chunks, threads, [&](int64_t c) {
        int64_t at = c * kChunk;
        std::vector<uint32_t> touched;  // moved at the end: neighbours in tiles_of_ share cache lines between threads
        const Buffer<uint32_t> some_tiles = buffer<uint32_t>((int64_t)tiles_x_ * tiles_y_);
        int64_t rows[kChunk];
        const int64_t candidates = may_touch(kind_, splats, c * kChunk, outlook, rows, invalid[c], seen, radii);
        for (int64_t from = 0; from < candidates; from += kGroup) {
            const int64_t some = std::min(kGroup, candidates - from);
            Record group[kGroup];
            Bound<double> bounds[kGroup];
            bool drawn[kGroup];
            project_some(splats, rows + from, some, camera_, form_, group, bounds, drawn);
            const int64_t first = at;
            for (int64_t k = 0; k < some; k++) {
                if (!drawn[k]) continue;
                const Bound<double> b = widened(bounds[k]);
                const int tiles = inside(strip_, tiles_x_, some_tiles.get(),
                                         kernel.tiles(b, tiles_x_, tiles_y_, rim_, some_tiles.get()));
                if (!tiles) continue;
                touched.insert(touched.end(), some_tiles.get(), some_tiles.get() + tiles);
                tiles_[at] = (uint32_t)tiles;
                const int64_t i = rows[from + k];
                fill_bound(group[k], b);
                records[at] = group[k];
                index_[at] = i;
                seen[i] = true;
                radii[i] = (float)std::sqrt(std::max({bounds[k].hxx, bounds[k].hyy, bounds[k].r2}));
                at++;
            }
            double rgb[kGroup][3];
            if (splats.coefficients) {
                kernel.shade(splats, index_.get() + first, at - first, camera_, rgb);
            } else {
                for (int64_t r = first; r < at; r++)
                    for (int q = 0; q < 3; q++) rgb[r - first][q] = splats.sh0[3 * index_[r] + q];
            }
            for (int64_t r = first; r < at; r++) {
                const double* look = rgb[r - first];
                const int64_t i = index_[r];
                if (!std::isfinite(look[0] + look[1] + look[2]) && !(invalid[c] >= 0 && invalid[c] < i)) invalid[c] = i;
                for (int q = 0; q < 3; q++) records[r].color[q] = (float)std::max(look[q], 0.0);
                const Vec<double> mean{splats.means[3 * i], splats.means[3 * i + 1], splats.means[3 * i + 2]};
                depth_[r] = (float)(splat::mul(camera_.turn, mean) + camera_.shift).z;
            }
        }
        tiles_of_[c] = std::move(touched);
        seen_in_[c] = (int32_t)(at - c * kChunk);
    });
    for (int64_t i : invalid)
        if (i >= 0 && first_invalid < 0) first_invalid = i;
}

void Pass::bin(int threads) {
    std::vector<uint32_t> at;  // records, in the order of the splats
    std::vector<float> keys;
    const int64_t seen = std::accumulate(seen_in_.begin(), seen_in_.end(), (int64_t)0);
    at.reserve(seen);
    keys.reserve(seen);
    int64_t pairs = 0;
    for (size_t c = 0; c < seen_in_.size(); c++)
        for (int64_t r = c * kChunk; r < (int64_t)c * kChunk + seen_in_[c]; r++) {
            at.push_back((uint32_t)r);
            keys.push_back(depth_[r]);
            slot_[r] = (uint32_t)pairs;
            pairs += tiles_[r];
        }
    const std::vector<uint32_t> order = order_of(keys);
    const int tiles = tiles_x_ * tiles_y_;
    if (pairs > std::numeric_limits<uint32_t>::max())
        throw std::length_error("more than 2^32 pairs of a splat and a tile in one view");
    pairs_ = pairs;
    entries_ = buffer<Entry>(pairs);
    offsets_.assign(tiles + 1, 0);
    // Counting sort by tile, stable in depth: pieces of the depth order count, then place.
    const int64_t pieces = std::min<int64_t>(std::max(1, threads), chunks_of(seen, 1024)),
                  size = pieces ? chunks_of(seen, pieces) : 0;
    std::vector<uint32_t> tile_of(pairs);  // by slot
    int64_t copied = 0;
    for (const auto& tiles_of : tiles_of_) {
        std::copy(tiles_of.begin(), tiles_of.end(), tile_of.begin() + copied);
        copied += (int64_t)tiles_of.size();
    }
    std::vector<std::vector<uint32_t>>().swap(tiles_of_);
    std::vector<int64_t> next((size_t)pieces * tiles, 0);
    parallel(pieces, threads, [&](int64_t p) {
        int64_t* counts = next.data() + p * tiles;
        for (int64_t k = p * size; k < std::min(seen, (p + 1) * size); k++) {
            const uint32_t r = at[order[k]];
            for (uint32_t slot = slot_[r]; slot < slot_[r] + tiles_[r]; slot++) counts[tile_of[slot]]++;
        }
    });
    int64_t sum = 0;
    for (int t = 0; t < tiles; t++) {
        offsets_[t] = sum;
        for (int64_t p = 0; p < pieces; p++) {
            const int64_t n = next[p * tiles + t];
            next[p * tiles + t] = sum;
            sum += n;
        }
    }
    offsets_[tiles] = sum;
    parallel(pieces, threads, [&](int64_t p) {
        int64_t* place = next.data() + p * tiles;
        for (int64_t k = p * size; k < std::min(seen, (p + 1) * size); k++) {
            const uint32_t r = at[order[k]];
            for (uint32_t slot = slot_[r]; slot < slot_[r] + tiles_[r]; slot++)
                entries_[place[tile_of[slot]]++] = {r, slot};
        }
    });
}

Job Pass::job() const {
    return {camera_.width,  camera_.height,  tiles_x_,     tiles_y_, records_.get(),
            entries_.get(), offsets_.data(), index_.get(), count_};
}

Saved Pass::saved() {
    return {open_.data(), last_.data(), middle_.data(), m_shift_.data(), m1_.data(),
            m2_.data(),   solid_.data(), fall_.data(),  blocks_.data()};
}

std::vector<int64_t> Pass::pairs_by_row() const {
    std::vector<int64_t> found(tiles_y_);
    for (int y = 0; y < tiles_y_; y++) found[y] = offsets_[(y + 1) * tiles_x_] - offsets_[y * tiles_x_];
    return found;
}

void Pass::forward(Level level, const Planes& out, int threads) {
    const size_t pixels = (size_t)camera_.width * camera_.height;
    level_ = level;
    open_.resize(pixels);
    last_.resize(pixels);
    if (level >= kGeometry) middle_.resize(pixels);
    if (level >= kDistortion)
        for (auto* plane : {&m_shift_, &m1_, &m2_}) plane->resize(pixels);
    const bool solids = solid() && level >= kGeometry;
    if (solids)
        for (auto* plane : {&solid_, &fall_}) plane->resize(pixels);
    blocks_.assign(pairs_, 0);
    const Saved kept = saved();
    const Job work = job();
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads, [&](int64_t tile) {
        k.forward(kind_, level, work, tile, out, kept);
        if (solids) k.solid(work, tile, (float)camera_.near, out, kept);
    });
}

namespace {

// Floats per row of sums by kind, without and with the chosen signal, and where in them colour and that signal are.
struct Layout {
    int width, width_chosen, color_at, chosen_at;
};
Layout layout(Kind kind) {
    switch (kind) {
        case kSurfel:
            return {kSurfelSums, kSurfelSumsChosen, 16, 20};
        case kGaussian:
            return {kGaussianSums, kGaussianSumsChosen, 12, 16};
        default:
            return {kRaySums, kRaySumsChosen, 20, 24};
    }
}

// dL/d(splat) but for its colour of some rows, from their sums, `stride` numbers apart.
void gradients_of(Kind kind, const SplatArrays& splats, const int64_t* rows, int64_t count,
                  const CameraModel<double>& camera, const GaussianForm& form, const double* sums, int stride,
                  SplatGrad<double>* out) {
    if (kind == kSurfel) return kernels().surfels_backward(splats, rows, count, camera, sums, stride, out);
    for (int64_t k = 0; k < count; k++)
        out[k] = splat_backward(kind, read_splat(splats, rows[k], 3), camera, form, sums + k * stride);
}

}  // namespace

void Pass::backward(const SplatArrays& splats, const Planes& total, const Planes* chosen, bool absolute, int64_t rows,
                    const GradientArrays& out, int threads) {
    // Only what has a cotangent costs time.
    const Planes part = chosen ? *chosen : Planes{};
    Level level = kColor;
    if (total.depth || total.median || total.normal || part.depth || part.median || part.normal) level = kGeometry;
    if (total.distortion || part.distortion) level = kDistortion;
    if (level > level_) throw std::invalid_argument("a cotangent was given for a map that was not rendered");
    Chosen what = kNone;
    if (chosen) {
        what = part.alpha || part.depth || part.median || part.normal || part.distortion ? kChosenAll : kChosenColor;
        if (absolute) what = kChosenAbsolute;
    }
    const bool solids = solid() && (total.median || part.median);
    const Layout at = layout(kind_);
    const int width = chosen ? at.width_chosen : at.width, color_at = at.color_at, chosen_at = at.chosen_at;
    const Buffer<float> sums = buffer<float>(pairs_ * width);
    std::vector<uint8_t> touched(pairs(), 0);
    const Saved kept = saved();
    Job work = job();
    work.rows = rows;
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads, [&](int64_t tile) {
        k.backward(kind_, level, what, work, tile, total, part, kept, sums.get(), touched.data());
        if (solids) k.solid_backward(what, work, tile, total, part, kept, sums.get(), touched.data());
    });
    const int columns = scale_columns(kind_);
    const auto group = [&](int64_t from, int64_t end) {
        int64_t rows[kGroup], hit = 0;
        double all[kGroup * kRaySumsChosen] = {};
        for (int64_t r = from; r < end; r++) {
            double* const s = all + hit * width;
            const size_t slot = slot_[r];
            if (k.add_rows(sums.get() + slot * width, touched.data() + slot, tiles_[r], width, s))
                rows[hit++] = index_[r];
        }
        SplatGrad<double> gradients[kGroup];
        gradients_of(kind_, splats, rows, hit, camera_, form_, all, width, gradients);
        if (splats.coefficients) {
            k.shade_backward(splats, rows, hit, camera_, all + color_at, width, out.sh0, out.sh_rest, gradients);
        } else {
            for (int64_t h = 0; h < hit; h++)
                for (int64_t q = 0, i = 3 * rows[h]; q < 3; q++)
                    out.sh0[i + q] = splats.sh0[i + q] > 0 ? (float)all[h * width + color_at + q] : 0.0f;
        }
        for (int64_t h = 0; h < hit; h++) {
            const int64_t i = rows[h];
            const SplatGrad<double>& g = gradients[h];
            out.means[3 * i] = (float)g.mean.x;
            out.means[3 * i + 1] = (float)g.mean.y;
            out.means[3 * i + 2] = (float)g.mean.z;
            for (int q = 0; q < 4; q++) out.quats[4 * i + q] = (float)g.quat[q];
            for (int q = 0; q < columns; q++) out.scales[columns * i + q] = (float)g.scale[q];
            out.opacities[i] = (float)g.opacity;
            for (int q = 0; q < 2; q++) {
                out.signal[2 * i + q] = (float)g.signal[q];
                if (out.chosen) out.chosen[2 * i + q] = (float)all[h * width + chosen_at + q];
            }
        }
    };
    const auto clear = [&](int64_t from, int64_t to) {
        const auto zero = [&](float* values, int wide) {
            if (values && from < to) std::fill(values + wide * from, values + wide * to, 0.0f);
        };
        zero(out.means, 3);
        zero(out.quats, 4);
        zero(out.scales, columns);
        zero(out.opacities, 1);
        zero(out.sh0, 3);
        zero(out.sh_rest, 3 * std::max(0, splats.coefficients - 1));
        zero(out.signal, 2);
        zero(out.chosen, 2);
    };
    parallel((int64_t)seen_in_.size(), threads, [&](int64_t c) {
        clear(c * kChunk, std::min(rows, (c + 1) * kChunk));
        const int64_t end = c * kChunk + seen_in_[c];
        for (int64_t r = c * kChunk; r < end; r += kGroup) group(r, std::min(end, r + kGroup));
    });
}

void Pass::contribution(float alpha_power, float open_power, float* sum, int64_t* count, int threads) {
    const Buffer<float> sums = buffer<float>(pairs_ * 2);
    std::vector<uint8_t> touched(pairs(), 0);
    const Job work = job();
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads, [&](int64_t tile) {
        k.contribution(kind_, work, tile, alpha_power, open_power, sums.get(), touched.data());
    });
    each_seen(threads, [&](int64_t r) {
        double total = 0, pixels = 0;
        for (uint32_t slot = slot_[r]; slot < slot_[r] + tiles_[r]; slot++)
            if (touched[slot]) {
                total += sums[2 * (size_t)slot];
                pixels += sums[2 * (size_t)slot + 1];
            }
        sum[index_[r]] = (float)total;
        count[index_[r]] = (int64_t)pixels;
    });
}

void Pass::leading(int64_t* count, int threads) {
    std::vector<uint32_t> counts(pairs(), 0);
    const Job work = job();
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads,
             [&](int64_t tile) { k.leading(kind_, work, tile, counts.data()); });
    each_seen(threads, [&](int64_t r) {
        int64_t pixels = 0;
        for (uint32_t slot = slot_[r]; slot < slot_[r] + tiles_[r]; slot++) pixels += counts[slot];
        count[index_[r]] = pixels;
    });
}

void Pass::probe(const double* points, int64_t count, float* opacity, int threads) {
    const int tiles = tiles_x_ * tiles_y_;
    std::vector<std::vector<int64_t>> inside(tiles);
    for (int64_t i = 0; i < count; i++) {
        const double x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        opacity[i] = std::numeric_limits<float>::quiet_NaN();
        if (z > camera_.near && x >= 0 && y >= 0 && x < camera_.width && y < camera_.height)
            inside[(size_t)((int)y / kTile) * tiles_x_ + (int)x / kTile].push_back(i);
    }
    const Job work = job();
    const Kernels& k = kernels();
    parallel(tiles, threads, [&](int64_t tile) {
        std::vector<int64_t>& here = inside[tile];
        if (here.empty()) return;
        std::sort(here.begin(), here.end(),
                  [&](int64_t a, int64_t b) { return points[3 * a + 2] < points[3 * b + 2]; });
        const size_t size = (here.size() + kProbes - 1) / kProbes * kProbes;
        std::vector<float> x(size), y(size), z(size), open(size, 1.0f);
        const double ox = tile % tiles_x_ * kTile + kTile / 2, oy = tile / tiles_x_ * kTile + kTile / 2;
        for (size_t j = 0; j < size; j++) {
            const double* p = points + 3 * here[std::min(j, here.size() - 1)];
            x[j] = (float)(p[0] - ox);
            y[j] = (float)(p[1] - oy);
            z[j] = (float)p[2];
        }
        k.probe(kind_, work, tile, {(int64_t)size, x.data(), y.data(), z.data(), open.data()});
        for (size_t j = 0; j < here.size(); j++) opacity[here[j]] = 1 - open[j];
    });
}

void in_view(Kind kind, const SplatArrays& splats, const splat::CameraModel<double>& camera, Strip strip, int threads,
             bool* found) {
    const int columns = scale_columns(kind);
    const Outlook<double> outlook(camera);
    // What the strip shows alone is an image of its own, but for the slope of the footprints of gaussians, which is held
    // near the whole image: of these a box tells, larger by the most that the slope can be.
    CameraModel<double> part = camera;
    const int top = std::min(strip.first * kTile, camera.height), most = camera.height - top;
    part.cy -= top;
    part.height = strip.end >= 1 << 26 ? most : std::min(most, strip.end * kTile - top);
    const Outlook<double> narrow(part);
    const double steepest = std::max(camera.cy, camera.height - camera.cy) / camera.fy + 0.15 * camera.height / camera.fy;
    const double stretch = camera.fy * std::sqrt(splat::kCutoffSquared * (1 + steepest * steepest)) * 1.0001;
    const double margin = 2 + Outlook<double>::kMargin;
    const auto outside = [&](double scale, splat::Vec<double> c) {
        if (kind != kGaussian) return narrow.misses(kind, scale, c);
        if (outlook.misses(kind, scale, c)) return true;
        const double half = stretch * scale / c.z + margin, y = camera.fy * c.y / c.z + camera.cy - top;
        return y + half < 0 || y - half > part.height;
    };
    parallel(chunks_of(splats.count, kChunk), threads, [&](int64_t c) {
        for (int64_t i = c * kChunk; i < std::min(splats.count, (c + 1) * kChunk); i++) {
            SplatIn<double> in{};
            in.mean = {splats.means[3 * i], splats.means[3 * i + 1], splats.means[3 * i + 2]};
            for (int k = 0; k < columns; k++) in.scale[k] = splats.scales[columns * i + k];
            found[i] = !outside(largest_scale(in), splat::mul(camera.turn, in.mean) + camera.shift);
        }
    });
}

void shade(const SplatArrays& splats, const int64_t* rows, int64_t count, const splat::CameraModel<double>& camera,
           int threads, float* rgb) {
    parallel(chunks_of(count, kChunk), threads, [&](int64_t c) {
        const int64_t from = c * kChunk, some = std::min(kChunk, count - from);
        double look[kChunk][3];
        kernels().shade(splats, rows + from, some, camera, look);
        for (int64_t k = 0; k < some; k++)
            for (int q = 0; q < 3; q++) rgb[3 * (from + k) + q] = (float)look[k][q];
    });
}

void shade_backward(const SplatArrays& splats, const int64_t* rows, int64_t count,
                    const splat::CameraModel<double>& camera, int threads, const float* by_rgb, float* by_sh0,
                    float* by_sh_rest, float* by_means) {
    parallel(chunks_of(count, kChunk), threads, [&](int64_t c) {
        const int64_t from = c * kChunk, some = std::min(kChunk, count - from);
        double given[kChunk][3];
        std::vector<SplatGrad<double>> gradients(some);  // zeros
        for (int64_t k = 0; k < some; k++)
            for (int q = 0; q < 3; q++) given[k][q] = by_rgb[3 * (from + k) + q];
        kernels().shade_backward(splats, rows + from, some, camera, given[0], 3, by_sh0, by_sh_rest, gradients.data());
        for (int64_t k = 0; k < some; k++) {
            float* to = by_means + 3 * rows[from + k];
            to[0] = (float)(to[0] + gradients[k].mean.x);
            to[1] = (float)(to[1] + gradients[k].mean.y);
            to[2] = (float)(to[2] + gradients[k].mean.z);
        }
    });
}

double ssim(const float* x, const float* y, int channels, int width, int height, float* gradient, int threads) {
    const int band = 48, bands = (height + band - 1) / band;
    const size_t plane = (size_t)width * height;
    std::vector<double> sums((size_t)channels * bands);
    const Buffer<float> d = buffer<float>(3 * plane * channels);
    float *mean = d.get(), *square = mean + plane * channels, *cross = square + plane * channels;
    const Kernels& k = kernels();
    parallel((int64_t)channels * bands, threads, [&](int64_t i) {
        const size_t at = (i / bands) * plane;
        const int y0 = (int)(i % bands) * band, y1 = std::min(height, y0 + band);
        sums[i] = k.ssim_rows(x + at, y + at, width, height, y0, y1, mean + at, square + at, cross + at);
    });
    const double scale = 1.0 / ((double)plane * channels);
    if (gradient)
        parallel((int64_t)channels * bands, threads, [&](int64_t i) {
            const size_t at = (i / bands) * plane;
            const int y0 = (int)(i % bands) * band, y1 = std::min(height, y0 + band);
            k.ssim_gradient_rows(x + at, y + at, mean + at, square + at, cross + at, width, height, y0, y1,
                                 (float)scale, gradient + at);
        });
    double sum = 0;
    for (double s : sums) sum += s;
    return sum * scale;
}

double normal_disagreement(NormalJob job, float* d_depth, int threads) {
    const int w = job.width, h = job.height, band = 16, bands = std::max(0, (h - 2 + band - 1) / band);
    const size_t plane = (size_t)w * h;
    std::fill(d_depth, d_depth + plane, 0.0f);
    std::fill(job.d_normal, job.d_normal + 3 * plane, 0.0f);
    if (w < 3 || h < 3) return 0;
    const double count = (double)(w - 2) * (h - 2);
    job.scale = (float)(1 / count);
    const Buffer<float> sent = buffer<float>(4 * plane);  // written for inner pixels, and read for those alone
    job.to_right = sent.get();
    job.to_left = job.to_right + plane;
    job.to_below = job.to_left + plane;
    job.to_above = job.to_below + plane;
    std::vector<double> sums(bands);
    const Kernels& k = kernels();
    parallel(bands, threads, [&](int64_t b) {
        sums[b] = k.normal_rows(job, 1 + (int)b * band, std::min(h - 1, 1 + (int)(b + 1) * band));
    });
    parallel((h + band - 1) / band, threads, [&](int64_t b) {
        for (int y = (int)b * band; y < std::min(h, (int)(b + 1) * band); y++) {
            const size_t row = (size_t)y * w;
            const bool inner = y > 0 && y < h - 1;
            if (inner)
                for (int x = 2; x < w; x++) d_depth[row + x] += job.to_right[row + x - 1];
            if (inner)
                for (int x = 0; x < w - 2; x++) d_depth[row + x] += job.to_left[row + x + 1];
            if (y > 1)
                for (int x = 1; x < w - 1; x++) d_depth[row + x] += job.to_below[row + x - w];
            if (y < h - 2)
                for (int x = 1; x < w - 1; x++) d_depth[row + x] += job.to_above[row + x + w];
        }
    });
    double sum = 0;
    for (double s : sums) sum += s;
    return sum / count;
}

}  // namespace surfkit
