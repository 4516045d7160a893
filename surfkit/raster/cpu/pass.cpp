#include "pass.h"

#include <algorithm>
#include <cstring>
#include <limits>
#include <stdexcept>

#include "../../native/pool.h"

namespace surfkit {
namespace {

constexpr int64_t kChunk = 512;  // splats projected as one piece of work

using splat::Bound;
using splat::CameraModel;
using splat::Gaussian;
using splat::Posed;
using splat::SplatGrad;
using splat::SplatIn;
using splat::Surfel;
using splat::Vec;

int64_t chunks_of(int64_t count, int64_t size) { return (count + size - 1) / size; }

int scale_columns(Kind kind) { return kind == kSurfel ? 2 : 3; }

SplatIn<double> read_splat(const SplatArrays& s, int64_t i, int columns) {
    SplatIn<double> o{};
    o.mean = {s.means[3 * i], s.means[3 * i + 1], s.means[3 * i + 2]};
    for (int k = 0; k < 4; k++) o.quat[k] = s.quats[4 * i + k];
    for (int k = 0; k < columns; k++) o.scale[k] = s.scales[columns * i + k];
    o.opacity = s.opacities[i];
    return o;
}

bool valid(const SplatIn<double>& s, int columns) {
    double sum = s.mean.x + s.mean.y + s.mean.z + s.opacity, turn = 0;
    bool positive = true;
    for (double q : s.quat) turn += q * q;
    for (int k = 0; k < columns; k++) {
        sum += s.scale[k];
        positive = positive && s.scale[k] > 0;
    }
    return std::isfinite(sum) && std::isfinite(turn) && turn > 0 && positive;
}

// Colour of a splat seen from the camera, and what its gradient needs.
struct Shade {
    Vec<double> direction;
    double length, basis[16], rgb[3];
};
Shade shade(const SplatArrays& s, int64_t i, const SplatIn<double>& in, const CameraModel<double>& cam) {
    Shade o;
    const Vec<double> d = in.mean - cam.centre;
    o.length = std::sqrt(splat::dot(d, d));
    o.direction = (1 / std::max(o.length, 1e-300)) * d;
    splat::sh_basis(o.direction, s.coefficients, o.basis);
    const float* sh = s.sh + 3 * s.coefficients * i;
    for (int c = 0; c < 3; c++) {
        o.rgb[c] = 0.5;
        for (int k = 0; k < s.coefficients; k++) o.rgb[c] += o.basis[k] * sh[3 * k + c];
    }
    return o;
}
void shade_backward(const SplatArrays& s, int64_t i, const Shade& o, const double rgb[3], SplatGrad<double>& out,
                    float* sh_out) {
    double g[3], weight[16] = {};
    for (int c = 0; c < 3; c++) g[c] = o.rgb[c] > 0 ? rgb[c] : 0;
    const float* sh = s.sh + 3 * s.coefficients * i;
    for (int k = 0; k < s.coefficients; k++)
        for (int c = 0; c < 3; c++) {
            sh_out[3 * k + c] = (float)(g[c] * o.basis[k]);
            weight[k] += g[c] * sh[3 * k + c];
        }
    if (s.coefficients == 1 || !(o.length > 0)) return;
    const Vec<double> d = splat::sh_backward(o.direction, s.coefficients, weight);
    out.mean = out.mean + (1 / o.length) * (d - splat::dot(d, o.direction) * o.direction);
}

// A little larger than exact, so that the float32 row test never loses a pixel.
Bound<double> widened(Bound<double> b) {
    const double more = 1.0001, pad = 1e-3;
    b.hxx = b.hxx * more + pad;
    b.hxy *= more;
    b.hyy = b.hyy * more + pad;
    if (b.r2 > 0) {
        b.r2 = b.r2 * more + pad;
        // A disc inside the ellipse says nothing new.
        const double half = (b.hxx + b.hyy) / 2,
                     spread = std::sqrt((b.hxx - b.hyy) * (b.hxx - b.hyy) / 4 + b.hxy * b.hxy);
        if (half > spread && std::sqrt(half - spread) > std::sqrt(b.r2) + std::sqrt((b.dx - b.mx) * (b.dx - b.mx) +
                                                                                    (b.dy - b.my) * (b.dy - b.my)))
            b.r2 = -1;
    }
    return b;
}

template <class Record>
void fill_bound(Record& r, const Bound<double>& b) {
    const double tilt = b.hxy / b.hyy, ax = r.ax, ay = r.ay;
    r.mx = (float)(b.mx - ax);
    r.my = (float)(b.my - ay);
    r.tilt = (float)tilt;
    r.wide = (float)std::max(b.hxx - b.hxy * tilt, 0.0);
    r.flat = (float)(1 / b.hyy);
    r.disc_x = (float)(b.dx - ax);
    r.disc_y = (float)(b.dy - ay);
    r.disc_r2 = (float)b.r2;
}
template <class Record>
void fill_look(Record& r, double opacity, const Shade& look, Vec<double> normal) {
    r.opacity = (float)opacity;
    for (int c = 0; c < 3; c++) r.color[c] = (float)std::max(look.rgb[c], 0.0);
    r.normal[0] = (float)normal.x;
    r.normal[1] = (float)normal.y;
    r.normal[2] = (float)normal.z;
}

double whole(double x) { return std::floor(x); }

bool project_one(const SplatIn<double>& in, const CameraModel<double>& cam, bool, SurfelRecord& r,
                 Bound<double>& bound) {
    const Posed<double> p = splat::pose(in, cam);
    Surfel<double> s;
    if (!splat::surfel_project(in, p, cam, whole, s)) return false;
    bound = s.bound;
    r.ax = (float)s.ax;
    r.ay = (float)s.ay;
    const Vec<double> m[3] = {s.a, s.b, s.c};
    double* to[3] = {r.a, r.b, r.c};
    for (int k = 0; k < 3; k++) {
        to[k][0] = m[k].x;
        to[k][1] = m[k].y;
        to[k][2] = m[k].z;
    }
    r.det = (float)s.det;
    r.z_low = (float)s.z_low;
    r.z_high = (float)s.z_high;
    fill_look(r, in.opacity, Shade{}, s.flip * p.axes.c2);
    const splat::SignalRow<double> row = splat::surfel_signal(cam, s);
    for (int k = 0; k < 6; k++) r.signal_x[k] = (float)row.x[k];
    for (int k = 0; k < 3; k++) r.signal_y[k] = (float)row.y[k == 2 ? 4 : 2 * k + 1];
    return true;
}
bool project_one(const SplatIn<double>& in, const CameraModel<double>& cam, bool antialias, GaussianRecord& r,
                 Bound<double>& bound) {
    const Posed<double> p = splat::pose(in, cam);
    Gaussian<double> g;
    if (!splat::gaussian_project(in, p, cam, antialias, g)) return false;
    bound = g.bound;
    const double limit = 1 << 22, ax = whole(std::clamp(g.x, -limit, limit)) + 0.5,
                 ay = whole(std::clamp(g.y, -limit, limit)) + 0.5;
    r.x = (float)(g.x - ax);
    r.y = (float)(g.y - ay);
    r.l00 = (float)g.l00;
    r.l01 = (float)g.l01;
    r.l11 = (float)g.l11;
    r.z = (float)g.z;
    r.slope_x = (float)g.slope_x;
    r.slope_y = (float)g.slope_y;
    r.z_low = (float)g.z_low;
    r.z_high = (float)g.z_high;
    r.ax = (float)ax;
    r.ay = (float)ay;
    fill_look(r, in.opacity * g.compensation, Shade{}, g.normal);
    return true;
}

// What a camera sees, for leaving out early what lies well outside: in a large scene that is nearly everything.
struct Outlook {
    static constexpr double kMargin = 3;  // pixels; the low-pass filter of a surfel reaches 2.36
    const CameraModel<double>& cam;
    Vec<double> side[4];  // unit normals of the planes through the camera and the sides of the image, pointing away

    explicit Outlook(const CameraModel<double>& camera) : cam(camera) {
        const double left = -kMargin - cam.cx, right = cam.width + kMargin - cam.cx, top = -kMargin - cam.cy,
                     bottom = cam.height + kMargin - cam.cy;
        const Vec<double> away[4] = {{-cam.fx, 0, left}, {cam.fx, 0, -right}, {0, -cam.fy, top}, {0, cam.fy, -bottom}};
        for (int k = 0; k < 4; k++) side[k] = (1 / std::sqrt(splat::dot(away[k], away[k]))) * away[k];
    }

    // Whether a splat with its centre at c in the camera frame surely touches no pixel.
    bool misses(Kind kind, const SplatIn<double>& in, Vec<double> c) const {
        if (!(c.z > cam.near)) return true;
        const double reach =
            std::max({in.scale[0], in.scale[1], in.scale[2]}) * std::sqrt(splat::kCutoffSquared) * 1.0001;
        if (kind == kGaussian) return misses_blurred(reach, c);
        for (const Vec<double>& away : side)
            if (splat::dot(away, c) > reach) return true;
        return false;
    }

  private:
    // The footprint of a gaussian is affine in its covariance, at a slope that is held near the image.
    bool misses_blurred(double reach, Vec<double> c) const {
        const auto apart = [&](double slope, double f, double principal, int pixels) {
            const double more = 0.15 * pixels / f,
                         held = std::clamp(slope, -principal / f - more, (pixels - principal) / f + more);
            const double half = f / c.z * reach * std::sqrt(1 + held * held) + 2 + kMargin, at = f * slope + principal;
            return at + half < 0 || at - half > pixels;
        };
        return apart(c.x / c.z, cam.fx, cam.cx, cam.width) || apart(c.y / c.z, cam.fy, cam.cy, cam.height);
    }
};

// Calls f(tile) for the tiles that a bound touches. Tile t holds the pixel centres 16 t + rim ... 16 t + 16 - rim with
// a rim of 0.5; with none, what lies between them too.
template <class F>
void each_tile(const Bound<double>& b, int tiles_x, int tiles_y, double rim, F f) {
    const auto first = [&](double low, int tiles) {
        return (int)std::clamp(std::ceil((low + rim) / kTile - 1), 0.0, (double)tiles);
    };
    const auto end = [&](double high, int tiles) {
        return (int)std::clamp(std::floor((high - rim) / kTile) + 1, 0.0, (double)tiles);
    };
    const splat::Outline<double> o = splat::outline(b);
    const double disc = b.r2 > 0 ? std::sqrt(b.r2) : 0, dx = b.r2 > 0 ? b.dx : b.mx, dy = b.r2 > 0 ? b.dy : b.my;
    const int y0 = first(std::min(b.my - o.hy, dy - disc), tiles_y),
              y1 = end(std::max(b.my + o.hy, dy + disc), tiles_y);
    const int left = first(std::min(b.mx - o.hx, dx - disc), tiles_x),
              right = end(std::max(b.mx + o.hx, dx + disc), tiles_x);
    if (left >= right) return;
    for (int y = y0; y < y1; y++) {
        double low, high;
        if (!splat::bound_span(b, o, y * kTile + rim, (y + 1) * kTile - rim, low, high)) continue;
        const int x1 = end(high, tiles_x);
        for (int x = first(low, tiles_x); x < x1; x++) f((uint32_t)(y * tiles_x + x));
    }
}

// Stable order of `keys` (non-negative floats), as positions; least significant digit first.
std::vector<uint32_t> order_of(const std::vector<float>& keys) {
    const size_t n = keys.size();
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

}  // namespace

template <class F>
void Pass::each_seen(int threads, F f) const {
    parallel((int64_t)seen_in_.size(), threads, [&](int64_t c) {
        for (int64_t r = c * kChunk; r < c * kChunk + seen_in_[c]; r++) f(r);
    });
}

Pass::Pass(Kind kind, const SplatArrays& splats, const CameraModel<double>& camera, bool antialias, double rim,
           int threads, bool* seen, float* radii)
    : kind_(kind),
      camera_(camera),
      antialias_(antialias),
      rim_(rim),
      count_(splats.count),
      tiles_x_((camera.width + kTile - 1) / kTile),
      tiles_y_((camera.height + kTile - 1) / kTile) {
    kind == kSurfel ? project<SurfelRecord>(splats, threads, seen, radii)
                    : project<GaussianRecord>(splats, threads, seen, radii);
    if (first_invalid < 0) bin(threads);
}

template <class Record>
void Pass::project(const SplatArrays& splats, int threads, bool* seen, float* radii) {
    const int64_t n = splats.count, chunks = chunks_of(n, kChunk);
    const int columns = scale_columns(kind_);
    records_ = buffer<char>(n * sizeof(Record));
    tiles_of_.assign(chunks, {});
    index_ = buffer<int64_t>(n);
    depth_ = buffer<float>(n);
    slot_ = buffer<uint32_t>(n);
    tiles_ = buffer<uint32_t>(n);
    seen_in_.assign(chunks, 0);
    Record* records = (Record*)records_.get();
    std::vector<int64_t> invalid(chunks, -1);
    const Outlook outlook(camera_);
    parallel(chunks, threads, [&](int64_t c) {
        int64_t at = c * kChunk;
        std::vector<uint32_t> touched;  // moved at the end: neighbours in tiles_of_ share cache lines between threads
        for (int64_t i = c * kChunk; i < std::min(n, (c + 1) * kChunk); i++) {
            seen[i] = false;
            radii[i] = 0;
            const SplatIn<double> in = read_splat(splats, i, columns);
            if (!valid(in, columns)) {
                if (invalid[c] < 0) invalid[c] = i;
                continue;
            }
            const Vec<double> centre = splat::mul(camera_.turn, in.mean) + camera_.shift;
            if (outlook.misses(kind_, in, centre)) continue;
            Record r;
            Bound<double> b;
            if (!project_one(in, camera_, antialias_, r, b)) continue;
            const double radius = std::sqrt(std::max({b.hxx, b.hyy, b.r2}));
            b = widened(b);
            fill_bound(r, b);
            const size_t before = touched.size();
            each_tile(b, tiles_x_, tiles_y_, rim_, [&](uint32_t tile) { touched.push_back(tile); });
            const uint32_t tiles = (uint32_t)(touched.size() - before);
            if (!tiles) continue;
            const Shade look = shade(splats, i, in, camera_);
            if (!std::isfinite(look.rgb[0] + look.rgb[1] + look.rgb[2]) && invalid[c] < 0) invalid[c] = i;
            for (int k = 0; k < 3; k++) r.color[k] = (float)std::max(look.rgb[k], 0.0);
            records[at] = r;
            index_[at] = i;
            depth_[at] = (float)centre.z;
            tiles_[at] = tiles;
            seen[i] = true;
            radii[i] = (float)radius;
            at++;
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
    int64_t pairs = 0;
    for (size_t c = 0; c < seen_in_.size(); c++)
        for (int64_t r = c * kChunk; r < (int64_t)c * kChunk + seen_in_[c]; r++) {
            at.push_back((uint32_t)r);
            keys.push_back(depth_[r]);
            slot_[r] = (uint32_t)pairs;
            pairs += tiles_[r];
        }
    const std::vector<uint32_t> order = order_of(keys);
    const int64_t seen = (int64_t)at.size();
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
    return {open_.data(), last_.data(), middle_.data(), m_shift_.data(), m1_.data(), m2_.data(), blocks_.data()};
}

void Pass::forward(Level level, const Planes& out, int threads) {
    const size_t pixels = (size_t)camera_.width * camera_.height;
    level_ = level;
    open_.resize(pixels);
    last_.resize(pixels);
    if (level >= kGeometry) middle_.resize(pixels);
    if (level >= kDistortion)
        for (auto* plane : {&m_shift_, &m1_, &m2_}) plane->resize(pixels);
    blocks_.assign(pairs_, 0);
    const Saved kept = saved();
    const Job work = job();
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads,
             [&](int64_t tile) { k.forward(kind_, level, work, tile, out, kept); });
}

namespace {

splat::SurfelSums<double> surfel_sums(const double* s) {
    return {
        {s[0], s[1], s[2]}, {s[3], s[4], s[5]}, {s[6], s[7], s[8]}, s[9], {s[10], s[11]}, {s[12], s[13], s[14]}, s[15]};
}
splat::GaussianSums<double> gaussian_sums(const double* s) {
    return {s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], {s[8], s[9], s[10]}, s[11]};
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
    const int width =
        kind_ == kSurfel ? (chosen ? kSurfelSumsChosen : kSurfelSums) : (chosen ? kGaussianSumsChosen : kGaussianSums);
    const int color_at = kind_ == kSurfel ? 16 : 12, chosen_at = kind_ == kSurfel ? 20 : 16;
    const Buffer<float> sums = buffer<float>(pairs_ * width);
    std::vector<uint8_t> touched(pairs(), 0);
    const Saved kept = saved();
    Job work = job();
    work.rows = rows;
    const Kernels& k = kernels();
    parallel((int64_t)tiles_x_ * tiles_y_, threads, [&](int64_t tile) {
        k.backward(kind_, level, what, work, tile, total, part, kept, sums.get(), touched.data());
    });
    const int columns = scale_columns(kind_);
    each_seen(threads, [&](int64_t r) {
        double s[kSurfelSumsChosen] = {};
        bool hit = false;
        for (uint32_t slot = slot_[r]; slot < slot_[r] + tiles_[r]; slot++) {
            if (!touched[slot]) continue;
            hit = true;
            const float* row = sums.get() + (size_t)slot * width;
            for (int i = 0; i < width; i++) s[i] += row[i];
        }
        if (!hit) return;
        const int64_t i = index_[r];
        const SplatIn<double> in = read_splat(splats, i, columns);
        const Posed<double> p = splat::pose(in, camera_);
        SplatGrad<double> g;
        if (kind_ == kSurfel) {
            Surfel<double> o;
            splat::surfel_project(in, p, camera_, whole, o);
            splat::surfel_backward(in, p, camera_, o, surfel_sums(s), g);
        } else {
            Gaussian<double> o;
            splat::gaussian_project(in, p, camera_, antialias_, o);
            splat::gaussian_backward(in, p, camera_, antialias_, o, gaussian_sums(s), g);
        }
        shade_backward(splats, i, shade(splats, i, in, camera_), s + color_at, g, out.sh + 3 * splats.coefficients * i);
        out.means[3 * i] = (float)g.mean.x;
        out.means[3 * i + 1] = (float)g.mean.y;
        out.means[3 * i + 2] = (float)g.mean.z;
        for (int q = 0; q < 4; q++) out.quats[4 * i + q] = (float)g.quat[q];
        for (int q = 0; q < columns; q++) out.scales[columns * i + q] = (float)g.scale[q];
        out.opacities[i] = (float)g.opacity;
        for (int q = 0; q < 2; q++) {
            out.signal[2 * i + q] = (float)g.signal[q];
            if (out.chosen) out.chosen[2 * i + q] = (float)s[chosen_at + q];
        }
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
