// Point by point (Bowyer 1981, Watson 1981), in rounds that double their number, each along a Hilbert curve (Amenta,
// Choi and Rote 2003). Coordinates are integers of 22 bits: where doubles leave the sign of a determinant open, 128 bits
// hold it exactly.
#include "delaunay.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <stdexcept>
#include <utility>

namespace surfkit {
namespace {

using Wide = __int128;

constexpr int BITS = 22;
constexpr int32_t SIDE = 1 << BITS;
// A ball of this radius about the middle of the cube lies within the tetrahedron of four of its corners, whose
// inscribed ball has SIDE / sqrt(12).
constexpr double RADIUS = 0.288 * SIDE;
constexpr int CURVE_BITS = 16;

struct Place {
    int32_t x, y, z;
};

int sign(Wide value) { return (value > 0) - (value < 0); }

// Of the volume of a, b, c, d: positive if a, b, c turn to the left as d sees them from the other side.
int orientation(const Place& a, const Place& b, const Place& c, const Place& d) {
    const int64_t bx = b.x - a.x, by = b.y - a.y, bz = b.z - a.z, cx = c.x - a.x, cy = c.y - a.y, cz = c.z - a.z;
    const int64_t dx = d.x - a.x, dy = d.y - a.y, dz = d.z - a.z;
    const int64_t m = cy * dz - cz * dy, n = cz * dx - cx * dz, o = cx * dy - cy * dx;  // below 2^46
    const double u = (double)bx * (double)m, v = (double)by * (double)n, w = (double)bz * (double)o;
    const double sum = u + v + w;
    if (std::fabs(sum) > 1e-15 * (std::fabs(u) + std::fabs(v) + std::fabs(w))) return sum > 0 ? 1 : -1;
    return sign((Wide)bx * m + (Wide)by * n + (Wide)bz * o);
}

// Whether e lies within (1), on (0) or outside of the sphere through a, b, c, d, which are positively oriented.
int in_sphere(const Place& a, const Place& b, const Place& c, const Place& d, const Place& e) {
    const int64_t ax = a.x - e.x, ay = a.y - e.y, az = a.z - e.z, bx = b.x - e.x, by = b.y - e.y, bz = b.z - e.z;
    const int64_t cx = c.x - e.x, cy = c.y - e.y, cz = c.z - e.z, dx = d.x - e.x, dy = d.y - e.y, dz = d.z - e.z;
    const int64_t ab = ax * by - bx * ay, bc = bx * cy - cx * by, cd = cx * dy - dx * cy;  // below 2^46
    const int64_t da = dx * ay - ax * dy, ac = ax * cy - cx * ay, bd = bx * dy - dx * by;
    const int64_t a2 = ax * ax + ay * ay + az * az, b2 = bx * bx + by * by + bz * bz;
    const int64_t c2 = cx * cx + cy * cy + cz * cz, d2 = dx * dx + dy * dy + dz * dz;
    {
        const double p = (double)az * bc, q = (double)bz * ac, r = (double)cz * ab;
        const double s = (double)bz * cd, t = (double)cz * bd, u = (double)dz * bc;
        const double v = (double)cz * da, w = (double)dz * ac, x = (double)az * cd;
        const double y = (double)dz * ab, z = (double)az * bd, k = (double)bz * da;
        const double sum = c2 * (y + z + k) - d2 * (p - q + r) + (a2 * (s - t + u) - b2 * (v + w + x));
        const double most = c2 * (std::fabs(y) + std::fabs(z) + std::fabs(k)) +
                            d2 * (std::fabs(p) + std::fabs(q) + std::fabs(r)) +
                            a2 * (std::fabs(s) + std::fabs(t) + std::fabs(u)) +
                            b2 * (std::fabs(v) + std::fabs(w) + std::fabs(x));
        if (std::fabs(sum) > 2e-15 * most) return sum > 0 ? 1 : -1;
    }
    const Wide abc = (Wide)az * bc - (Wide)bz * ac + (Wide)cz * ab, bcd = (Wide)bz * cd - (Wide)cz * bd + (Wide)dz * bc;
    const Wide cda = (Wide)cz * da + (Wide)dz * ac + (Wide)az * cd, dab = (Wide)dz * ab + (Wide)az * bd + (Wide)bz * da;
    return sign((c2 * dab - d2 * abc) + (a2 * bcd - b2 * cda));
}

// How far along a Hilbert curve through a cube of 2^CURVE_BITS cells a side (Skilling 2004).
uint64_t along_curve(std::array<uint32_t, 3> x) {
    for (uint32_t bit = 1u << (CURVE_BITS - 1); bit > 1; bit >>= 1) {
        const uint32_t below = bit - 1;
        for (int i = 0; i < 3; i++) {
            if (x[i] & bit) {
                x[0] ^= below;
            } else {
                const uint32_t t = (x[0] ^ x[i]) & below;
                x[0] ^= t, x[i] ^= t;
            }
        }
    }
    x[1] ^= x[0], x[2] ^= x[1];
    uint32_t t = 0;
    for (uint32_t bit = 1u << (CURVE_BITS - 1); bit > 1; bit >>= 1)
        if (x[2] & bit) t ^= bit - 1;
    uint64_t found = 0;
    for (int bit = CURVE_BITS - 1; bit >= 0; bit--)
        for (int i = 0; i < 3; i++) found = found << 1 | (((x[i] ^ t) >> bit) & 1);
    return found;
}

uint64_t mixed(uint64_t x) {  // splitmix64 (Steele, Lea and Flood 2014)
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
    x = (x ^ x >> 27) * 0x94d049bb133111ebu;
    return x ^ x >> 31;
}

struct Tet {
    std::array<int32_t, 4> corner, next;
};

class Builder {
  public:
    explicit Builder(const std::vector<Place>& places) : places(places) {
        const int32_t first = (int32_t)places.size() - 4;
        Tet whole{{first, first + 1, first + 2, first + 3}, {-1, -1, -1, -1}};
        if (orientation(places[first], places[first + 1], places[first + 2], places[first + 3]) < 0)
            std::swap(whole.corner[0], whole.corner[1]);
        tets.push_back(whole);
        seen.push_back(0);
    }

    bool insert(int32_t point) {
        const int32_t start = find(point);
        for (const int32_t corner : tets[start].corner)
            if (same(corner, point)) return false;
        round += 2;  // seen[t] is `round` in the cavity, `round` - 1 where it was found not to be
        cavity.assign(1, start), seen[start] = round;
        for (size_t at = 0; at < cavity.size(); at++) spread(cavity[at], point);
        // Where points share a sphere, a face of the cavity may lie edge-on to the point: what is behind it joins too.
        for (bool whole = false; !whole;) {
            whole = true;
            walls.clear();
            for (size_t at = 0; at < cavity.size(); at++)
                for (int i = 0; i < 4; i++) {
                    const int32_t t = cavity[at], beyond = tets[t].next[i];
                    if (beyond >= 0 && seen[beyond] == round) continue;
                    if (side(t, i, point) > 0) {
                        walls.push_back({t, i, beyond, beyond < 0 ? -1 : opposite(beyond, t, i)});
                    } else {
                        if (beyond < 0) return false;
                        seen[beyond] = round, cavity.push_back(beyond), whole = false;
                    }
                }
        }
        fill(point);
        return true;
    }

    std::vector<Tet> tets;

  private:
    struct Wall {
        int32_t tet, corner, beyond, back;
    };
    struct Seam {
        uint64_t edge;
        int32_t tet, corner;
        uint32_t round;
    };

    bool same(int32_t a, int32_t b) const {
        return places[a].x == places[b].x && places[a].y == places[b].y && places[a].z == places[b].z;
    }

    // On which side of the face opposite to corner i of a tetrahedron a point lies: 1 on that of the corner.
    int side(int32_t t, int i, int32_t point) const {
        std::array<int32_t, 4> c = tets[t].corner;
        c[i] = point;
        return orientation(places[c[0]], places[c[1]], places[c[2]], places[c[3]]);
    }

    int32_t find(int32_t point) const {
        int32_t t = last, from = -1;
        for (;;) {
            int i = 0;
            for (; i < 4; i++)
                if (const int32_t next = tets[t].next[i]; next >= 0 && next != from && side(t, i, point) < 0) break;
            if (i == 4) return t;
            from = t, t = tets[t].next[i];
        }
    }

    void spread(int32_t t, int32_t point) {
        for (const int32_t next : tets[t].next) {
            if (next < 0 || seen[next] >= round - 1) continue;
            const auto& c = tets[next].corner;
            const bool within = in_sphere(places[c[0]], places[c[1]], places[c[2]], places[c[3]], places[point]) > 0;
            seen[next] = within ? round : round - 1;
            if (within) cavity.push_back(next);
        }
    }

    // Each wall of the cavity becomes a tetrahedron with the point.
    void fill(int32_t point) {
        size_t need = 64;
        while (need < 8 * walls.size()) need *= 2;
        if (seams.size() < need) seams.assign(need, Seam{0, 0, 0, 0});
        made.clear();
        for (const Wall& wall : walls) {
            Tet tet = tets[wall.tet];
            tet.corner[wall.corner] = point;
            for (int i = 0; i < 4; i++)
                if (i != wall.corner) tet.next[i] = -1;
            made.push_back(tet);
        }
        rows.clear();
        for (size_t at = 0; at < made.size(); at++) {
            int32_t row;
            if (at < cavity.size()) {
                row = cavity[at];
            } else if (!empty.empty()) {
                row = empty.back(), empty.pop_back();
            } else {
                row = (int32_t)tets.size();
                tets.push_back(Tet{}), seen.push_back(0);
            }
            rows.push_back(row);
        }
        for (size_t at = made.size(); at < cavity.size(); at++) {
            tets[cavity[at]].corner[0] = -1;
            empty.push_back(cavity[at]);
        }
        for (size_t at = 0; at < made.size(); at++)
            if (walls[at].beyond >= 0) tets[walls[at].beyond].next[walls[at].back] = rows[at];
        for (size_t at = 0; at < made.size(); at++) join(made[at], (int32_t)at, walls[at].corner);
        for (size_t at = 0; at < made.size(); at++) tets[rows[at]] = made[at], seen[rows[at]] = 0;
        last = rows[0];
    }

    // Which corner of the tetrahedron beyond a face lies opposite to it: two may share several faces.
    int opposite(int32_t beyond, int32_t t, int i) const {
        for (int j = 0; j < 4; j++) {
            const auto& mine = tets[t].corner;
            const int32_t corner = tets[beyond].corner[j];
            if (tets[beyond].next[j] == t && (corner == mine[i] || std::find(mine.begin(), mine.end(), corner) == mine.end()))
                return j;
        }
        return -1;
    }

    // The other three faces hold the point and an edge of the wall each, which two new tetrahedra share.
    void join(Tet& tet, int32_t at, int wall) {
        for (int i = 0; i < 4; i++) {
            if (i == wall) continue;
            uint32_t ends[2];
            int found = 0;
            for (int k = 0; k < 4; k++)
                if (k != i && k != wall) ends[found++] = (uint32_t)tet.corner[k];
            if (ends[0] > ends[1]) std::swap(ends[0], ends[1]);
            const uint64_t edge = (uint64_t)ends[0] << 32 | ends[1];
            size_t slot = mixed(edge) & (seams.size() - 1);
            while (seams[slot].round == round && seams[slot].edge != edge) slot = (slot + 1) & (seams.size() - 1);
            Seam& seam = seams[slot];
            if (seam.round != round) {
                seam = {edge, at, i, round};
            } else {
                tet.next[i] = rows[seam.tet];
                made[seam.tet].next[seam.corner] = rows[at];
            }
        }
    }

    const std::vector<Place>& places;
    std::vector<uint32_t> seen;
    uint32_t round = 0;
    int32_t last = 0;
    std::vector<int32_t> cavity, empty, rows;
    std::vector<Wall> walls;
    std::vector<Seam> seams;
    std::vector<Tet> made;
};

struct Extent {
    double middle[3] = {0, 0, 0}, reach = 0;  // of points, and how far the farthest lies from it
};

Extent extent_of(const double* points, int64_t count) {
    Extent found;
    double low[3], high[3], square = 0;
    for (int i = 0; i < 3; i++) {
        low[i] = high[i] = count ? points[i] : 0;
        for (int64_t p = 1; p < count; p++) {
            low[i] = std::min(low[i], points[3 * p + i]);
            high[i] = std::max(high[i], points[3 * p + i]);
        }
        found.middle[i] = (low[i] + high[i]) / 2;
    }
    for (int64_t p = 0; p < count; p++) {
        double sum = 0;
        for (int i = 0; i < 3; i++) sum += (points[3 * p + i] - found.middle[i]) * (points[3 * p + i] - found.middle[i]);
        square = std::max(square, sum);
    }
    found.reach = std::sqrt(square);
    return found;
}

}  // namespace

double least_step(const double* points, int64_t count) {
    const double reach = extent_of(points, count).reach;
    return reach > 0 ? reach / RADIUS : 1;
}

Tetrahedra tetrahedralise(const double* points, int64_t count, double step) {
    Tetrahedra found;
    const Extent extent = extent_of(points, count);
    if (!(extent.reach <= 1.0001 * RADIUS * step)) throw std::invalid_argument("the step is too small for these points");
    double middle[3];
    for (int i = 0; i < 3; i++) middle[i] = std::round(extent.middle[i] / step);  // steps
    std::vector<Place> places(count + 4);
    std::vector<std::pair<uint64_t, int32_t>> order(count);
    for (int64_t p = 0; p < count; p++) {
        std::array<uint32_t, 3> at;
        for (int i = 0; i < 3; i++)
            at[i] = (uint32_t)(std::llround(points[3 * p + i] / step) - (int64_t)middle[i] + SIDE / 2);
        places[p] = {(int32_t)at[0], (int32_t)at[1], (int32_t)at[2]};
        for (uint32_t& x : at) x >>= BITS - CURVE_BITS;
        const uint64_t chance = mixed((uint64_t)p);
        int turn = 15;  // the last round has half of the points, the one before a quarter
        while (turn > 0 && !(chance >> (15 - turn) & 1)) turn--;
        order[p] = {(uint64_t)turn << 3 * CURVE_BITS | along_curve(at), (int32_t)p};
    }
    const Place around[4] = {{0, 0, 0}, {SIDE, SIDE, 0}, {SIDE, 0, SIDE}, {0, SIDE, SIDE}};
    for (int k = 0; k < 4; k++) {
        places[count + k] = around[k];
        const int32_t at[3] = {around[k].x, around[k].y, around[k].z};
        for (int i = 0; i < 3; i++) found.enclosing.push_back((at[i] - SIDE / 2 + middle[i]) * step);
    }
    std::sort(order.begin(), order.end());
    Builder builder(places);
    for (const auto& next : order) found.left_out += !builder.insert(next.second);
    std::vector<int32_t> row(builder.tets.size(), -1);
    int32_t kept = 0;
    for (size_t t = 0; t < row.size(); t++)
        if (builder.tets[t].corner[0] >= 0) row[t] = kept++;
    found.corners.reserve(4 * (size_t)kept), found.neighbours.reserve(4 * (size_t)kept);
    for (const Tet& tet : builder.tets) {
        if (tet.corner[0] < 0) continue;
        for (int i = 0; i < 4; i++) {
            found.corners.push_back(tet.corner[i]);
            found.neighbours.push_back(tet.next[i] < 0 ? -1 : row[tet.next[i]]);
        }
    }
    return found;
}

}  // namespace surfkit
