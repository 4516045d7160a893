// Garland and Heckbert, "Surface simplification using quadric error metrics", 1997, with the planes of open boundaries.
// An edge is collapsed only where the surface stays what it is (Dey, Edelsbrunner, Guha and Nekhayev, "Topology preserving
// edge contraction", 1999), so no edge gets a third triangle.
#include "collapse.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace surfkit {
namespace {

constexpr int kMostFaces = 64;       // around a vertex
constexpr double kTurn = 0.2;        // least cosine between the normals of a triangle before and after
constexpr double kThin = 0.02;       // least height of a triangle over its longest side, unless it was thinner before
constexpr double kHold = 1e-4;       // pull to the middle of the edge, where the planes leave a direction open
constexpr double kGrow = 1e-6;       // share by which the area around an edge may grow, where all is flat
constexpr double kFar = 1.0;         // a vertex moves no farther than this from the middle, in lengths of the edge
constexpr size_t kShare = 16;        // of the edges, the cheapest are in the heap, which then fits into the cache

struct Point {
    double x, y, z;
};
inline Point operator+(Point a, Point b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Point operator-(Point a, Point b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Point operator*(double s, Point a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Point a, Point b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Point cross(Point a, Point b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// x A x + 2 b x + c, where x is relative to the vertex that has it: with far origins, floats would not do.
template <class T>
struct Quadric {
    T xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0, x = 0, y = 0, z = 0, c = 0;

    void add_plane(Point n, double offset, double weight) {
        xx += (T)(weight * n.x * n.x), xy += (T)(weight * n.x * n.y), xz += (T)(weight * n.x * n.z);
        yy += (T)(weight * n.y * n.y), yz += (T)(weight * n.y * n.z), zz += (T)(weight * n.z * n.z);
        x += (T)(weight * n.x * offset), y += (T)(weight * n.y * offset), z += (T)(weight * n.z * offset);
        c += (T)(weight * offset * offset);
    }
    Point times(Point p) const {
        return {xx * p.x + xy * p.y + xz * p.z, xy * p.x + yy * p.y + yz * p.z, xz * p.x + yz * p.y + zz * p.z};
    }
    double at(Point p) const { return dot(p, times(p)) + 2 * dot({x, y, z}, p) + c; }
    // The same about another origin.
    Quadric<double> about(Point p) const {
        const Point b = times(p) + Point{x, y, z};
        return {xx, xy, xz, yy, yz, zz, b.x, b.y, b.z, at(p)};
    }
};

Quadric<double> operator+(const Quadric<double>& a, const Quadric<double>& b) {
    return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz,
            a.zz + b.zz, a.x + b.x,   a.y + b.y,   a.z + b.z,   a.c + b.c};
}

Quadric<float> narrow(const Quadric<double>& q) {
    return {(float)q.xx, (float)q.xy, (float)q.xz, (float)q.yy, (float)q.yz,
            (float)q.zz, (float)q.x,  (float)q.y,  (float)q.z,  (float)q.c};
}

struct Edge {
    float cost;
    int32_t u, v;
    uint32_t stamp;  // changes of both ends when it was looked at
};
// The cheapest on top; ties by number, so that the result is one.
constexpr auto later = [](const Edge& a, const Edge& b) {
    return a.cost != b.cost ? a.cost > b.cost : a.u != b.u ? a.u > b.u : a.v > b.v;
};

struct Neighbour {
    int32_t vertex;
    int faces;  // that have the edge
};

class Collapse {
public:
    explicit Collapse(const CollapseJob& job)
        : job_(job),
          places_(job.vertices, job.vertices + 3 * job.vertex_count),
          faces_(job.faces, job.faces + 3 * job.face_count),
          next_(3 * job.face_count),
          head_(job.vertex_count, -1),
          parent_(job.vertex_count),
          changes_(job.vertex_count, 0),
          quadrics_(job.vertex_count),
          left_(job.face_count) {
        for (int64_t c = 3 * job.face_count - 1; c >= 0; c--) next_[c] = head_[faces_[c]], head_[faces_[c]] = (int32_t)c;
        for (int64_t v = 0; v < job.vertex_count; v++) parent_[v] = (int32_t)v;
        find_planes();
    }

    Collapsed run() {
        collapse_all();
        thin_too_ = std::isinf(job_.limit);  // where only the number counts, it is worth thin triangles
        if (thin_too_ && left_ > job_.least) collapse_all();
        return result();
    }

private:
    void collapse_all() {
        heap_.clear(), dear_.clear();
        sorted_to_ = -1;
        for (int32_t u = 0; u < job_.vertex_count; u++) {
            neighbours(u, around_);
            for (const Neighbour& n : around_)
                if (n.vertex > u) look_at(u, n.vertex);
        }
        forget_old();
        while (left_ > job_.least && (!heap_.empty() || fill_heap())) {
            std::pop_heap(heap_.begin(), heap_.end(), later);
            const Edge edge = heap_.back();
            heap_.pop_back();
            if (is_now(edge)) try_collapse(edge.u, edge.v);
        }
    }

    Point place(int32_t v) const { return {places_[3 * (int64_t)v], places_[3 * (int64_t)v + 1], places_[3 * (int64_t)v + 2]}; }
    bool is_now(const Edge& e) const { return changes_[e.u] + changes_[e.v] == e.stamp; }

    // Every corner of a vertex that is left; those of triangles that went are taken out of the list.
    template <class Body>
    void each_corner(int32_t v, const Body& body) {
        int32_t* link = &head_[v];
        while (*link >= 0) {
            const int32_t c = *link;
            if (faces_[c] < 0) {
                *link = next_[c];
                continue;
            }
            body(c);
            link = &next_[c];
        }
    }

    // Triangles of a vertex, and `most` if they are more: the middle of a fan over a large hole has thousands.
    int corners(int32_t v, int most) const {
        int count = 0;
        for (int32_t c = head_[v]; c >= 0 && count < most; c = next_[c]) count += faces_[c] >= 0;
        return count;
    }

    static int32_t after(int32_t c) { return c % 3 == 2 ? c - 2 : c + 1; }

    void neighbours(int32_t v, std::vector<Neighbour>& found) {
        found.clear();
        const auto count = [&](int32_t n) {
            for (Neighbour& known : found)
                if (known.vertex == n) {
                    known.faces++;
                    return;
                }
            found.push_back({n, 1});
        };
        each_corner(v, [&](int32_t c) { count(faces_[after(c)]), count(faces_[after(after(c))]); });
    }

    void find_planes() {
        double sum = 0;
        for (int64_t f = 0; f < job_.face_count; f++) sum += std::sqrt(dot(normal(f), normal(f))) / 2;
        const double unit = std::max(sum / std::max<int64_t>(job_.face_count, 1), 1e-300);
        for (int64_t f = 0; f < job_.face_count; f++) {
            const Point n = normal(f);
            const double size = std::sqrt(dot(n, n));
            if (size == 0) continue;
            for (int k = 0; k < 3; k++) quadrics_[faces_[3 * f + k]].add_plane(1 / size * n, 0, size / 2 / unit);
        }
        for (int32_t u = 0; u < job_.vertex_count; u++) {
            neighbours(u, around_);
            const auto is_rim = [&](int32_t n) {
                return std::any_of(around_.begin(), around_.end(), [&](const Neighbour& k) { return k.vertex == n && k.faces == 1; });
            };
            each_corner(u, [&](int32_t c) {
                for (const int32_t v : {faces_[after(c)], faces_[after(after(c))]}) {
                    if (!is_rim(v)) continue;
                    const Point along = place(v) - place(u), across = cross(along, normal(c / 3));
                    const double size = std::sqrt(dot(across, across));
                    if (size > 0) quadrics_[u].add_plane(1 / size * across, 0, dot(along, along) / unit);
                }
            });
        }
    }

    Point normal(int64_t f) const {
        const Point a = place(faces_[3 * f]);
        return cross(place(faces_[3 * f + 1]) - a, place(faces_[3 * f + 2]) - a);
    }

    // Where an edge would best go, relative to its middle, and what that costs.
    std::pair<Point, double> best(int32_t u, int32_t v) const {
        const Point half = 0.5 * (place(v) - place(u));
        const Quadric<double> q = quadrics_[u].about(half) + quadrics_[v].about(-1 * half);
        if (job_.fixed[u] || job_.fixed[v]) {
            const Point p = job_.fixed[u] ? -1 * half : half;
            return {p, std::max(q.at(p), 0.0)};
        }
        const double hold = kHold * (q.xx + q.yy + q.zz);
        const double xx = q.xx + hold, yy = q.yy + hold, zz = q.zz + hold;
        const Point rows[] = {{xx, q.xy, q.xz}, {q.xy, yy, q.yz}, {q.xz, q.yz, zz}};
        const Point right = {-q.x, -q.y, -q.z};
        const double volume = dot(rows[0], cross(rows[1], rows[2]));
        if (volume > 0) {
            const Point p = 1 / volume * Point{dot(right, cross(rows[1], rows[2])), dot(right, cross(rows[2], rows[0])),
                                               dot(right, cross(rows[0], rows[1]))};
            if (dot(p, p) <= 4 * kFar * kFar * dot(half, half)) return {p, std::max(q.at(p), 0.0)};
        }
        Point found{0, 0, 0};
        for (const Point p : {-1 * half, half})
            if (q.at(p) < q.at(found)) found = p;
        return {found, std::max(q.at(found), 0.0)};
    }

    void look_at(int32_t u, int32_t v) {
        if (job_.fixed[u] && job_.fixed[v]) return;
        const double cost = best(u, v).second;
        if (!(cost <= job_.limit)) return;
        const Edge edge{(float)cost, std::min(u, v), std::max(u, v), changes_[u] + changes_[v]};
        if (edge.cost > sorted_to_) {
            dear_.push_back(edge);
        } else {
            heap_.push_back(edge);
            std::push_heap(heap_.begin(), heap_.end(), later);
        }
    }

    // Whether the surface stays what it is: the edge has one or two triangles, and nothing else connects its ends.
    bool stays_a_surface(int32_t u, int32_t v) {
        const int most = kMostFaces + 4;  // with the two at the edge, seen from both ends
        if (corners(u, most + 1) + corners(v, most + 1) > most) return false;
        neighbours(u, around_), neighbours(v, beyond_);
        int shared = 0, common = 0;
        int32_t opposite[2] = {-1, -1};
        bool rim_u = false, rim_v = false;
        for (const Neighbour& n : around_) {
            if (n.faces > 2) return false;
            rim_u |= n.faces == 1;
            if (n.vertex == v) shared = n.faces;
            for (const Neighbour& m : beyond_)
                if (m.vertex == n.vertex) {
                    if (common < 2) opposite[common] = n.vertex;
                    common++;
                }
        }
        for (const Neighbour& n : beyond_) {
            if (n.faces > 2) return false;
            rim_v |= n.faces == 1;
        }
        if (shared < 1 || common != shared || (rim_u && rim_v && shared == 2)) return false;
        int faces = 0, closing = 0;
        each_corner(u, [&](int32_t c) {
            const int32_t a = faces_[after(c)], b = faces_[after(after(c))];
            faces += a != v && b != v;
            closing += shared == 2 && std::min(a, b) == std::min(opposite[0], opposite[1]) && std::max(a, b) == std::max(opposite[0], opposite[1]);
        });
        each_corner(v, [&](int32_t c) { faces += faces_[after(c)] != u && faces_[after(after(c))] != u; });
        if (!faces || faces > kMostFaces || closing) return false;
        for (int k = 0; k < shared; k++)
            if (corners(opposite[k], 2) < 2) return false;  // the tip of an ear, which would go with it
        return true;
    }

    // Whether a triangle of u, without v, would turn over or become thin. `grown` is what the area grows by.
    bool spoils(int32_t u, int32_t v, Point p, double& grown) {
        bool found = false;
        each_corner(u, [&](int32_t c) {
            const int32_t b = faces_[after(c)], d = faces_[after(after(c))];
            const Point from = place(u), to_b = place(b), to_d = place(d);
            const Point before = cross(to_b - from, to_d - from), now = cross(to_b - p, to_d - p);
            const double old_size = std::sqrt(dot(before, before)), size = std::sqrt(dot(now, now));
            if (b == v || d == v) {
                grown -= old_size / 2;  // those of the edge are seen from both of its ends
                return;
            }
            grown += size - (1 + kGrow) * old_size;
            if (found || old_size == 0) return;
            const double rest = dot(to_d - to_b, to_d - to_b);
            const double old_long = std::max({dot(to_b - from, to_b - from), dot(to_d - from, to_d - from), rest});
            const double longest = std::max({dot(to_b - p, to_b - p), dot(to_d - p, to_d - p), rest});
            const bool thin = !thin_too_ && size < kThin * longest && size * old_long < old_size * longest;
            found = thin || dot(before, now) < kTurn * old_size * size;
        });
        return found;
    }

    void try_collapse(int32_t u, int32_t v) {
        if (job_.fixed[v]) std::swap(u, v);
        if (!stays_a_surface(u, v)) return;
        const Point middle = 0.5 * (place(u) + place(v));
        const Point to = best(u, v).first, p = middle + to;
        double grown = 0;
        if (spoils(u, v, p, grown) || spoils(v, u, p, grown) || (job_.flat && grown > 0)) return;
        quadrics_[u] = narrow(quadrics_[u].about(p - place(u)) + quadrics_[v].about(p - place(v)));
        int32_t last = -1;
        each_corner(v, [&](int32_t c) {
            const int64_t f = c / 3;
            if (faces_[after(c)] == u || faces_[after(after(c))] == u) {
                faces_[3 * f] = faces_[3 * f + 1] = faces_[3 * f + 2] = -1;
                left_--;
            } else {
                faces_[c] = u;
                last = c;
            }
        });
        if (last >= 0) {
            each_corner(v, [&](int32_t c) { last = c; });  // takes out what went, and finds the end
            next_[last] = head_[u], head_[u] = head_[v];
        }
        head_[v] = -1;
        parent_[v] = u;
        places_[3 * (int64_t)u] = (float)p.x, places_[3 * (int64_t)u + 1] = (float)p.y, places_[3 * (int64_t)u + 2] = (float)p.z;
        changes_[u]++, changes_[v]++;
        neighbours(u, around_);
        for (const Neighbour& n : around_) look_at(u, n.vertex);
        if (dear_.size() > 2 * live_) forget_old();
    }

    // Take out the edges that have changed since: memory stays bounded.
    void forget_old() {
        dear_.erase(std::remove_if(dear_.begin(), dear_.end(), [&](const Edge& e) { return !is_now(e); }), dear_.end());
        live_ = std::max<size_t>(dear_.size(), 1024);
    }

    // The heap is empty: take the cheapest of the other edges. False if there are none. Most of them change before it is
    // their turn, and so are never sorted.
    bool fill_heap() {
        forget_old();
        if (dear_.empty()) return false;
        const auto last = dear_.end() - 1 - (dear_.size() - 1) / kShare;
        std::nth_element(dear_.begin(), last, dear_.end(), later);
        sorted_to_ = last->cost;
        const auto cheap = std::partition(dear_.begin(), last, [&](const Edge& e) { return e.cost > sorted_to_; });
        heap_.assign(cheap, dear_.end());
        dear_.erase(cheap, dear_.end());
        std::make_heap(heap_.begin(), heap_.end(), later);
        return true;
    }

    Collapsed result() {
        Collapsed made;
        heap_ = {}, dear_ = {}, next_ = {}, quadrics_ = {}, changes_ = {};
        made.faces.reserve(3 * left_);
        std::vector<int32_t> number(job_.vertex_count, -1);
        for (const int32_t v : faces_) {
            if (v < 0) continue;
            number[v] = 0;
        }
        int32_t count = 0;
        for (int64_t v = 0; v < job_.vertex_count; v++)
            if (number[v] == 0) {
                number[v] = count++;
                made.vertices.insert(made.vertices.end(), &places_[3 * v], &places_[3 * v] + 3);
            }
        for (const int32_t v : faces_)
            if (v >= 0) made.faces.push_back(number[v]);
        made.into.resize(job_.vertex_count);
        for (int64_t v = 0; v < job_.vertex_count; v++) made.into[v] = number[root((int32_t)v)];
        return made;
    }

    int32_t root(int32_t v) {
        while (parent_[v] != v) v = parent_[v] = parent_[parent_[v]];
        return v;
    }

    const CollapseJob& job_;
    std::vector<float> places_;
    std::vector<int32_t> faces_, next_, head_, parent_;
    std::vector<uint32_t> changes_;
    std::vector<Quadric<float>> quadrics_;
    std::vector<Edge> heap_, dear_;  // edges that cost no more than sorted_to_, and the others
    std::vector<Neighbour> around_, beyond_;
    int64_t left_;
    size_t live_ = 0;
    float sorted_to_ = -1;
    bool thin_too_ = false;
};

}  // namespace

Collapsed collapse(const CollapseJob& job) { return Collapse(job).run(); }

}  // namespace surfkit
