// Two search trees, from the source and from the sink, that are kept from one path to the next (Boykov and Kolmogorov
// 2004). A node has four arcs at most, so its neighbours name them: no lists of arcs.
#include "cut.h"

#include <algorithm>
#include <deque>
#include <limits>
#include <vector>

namespace surfkit {
namespace {

constexpr int8_t NONE = -1, ROOT = 4, ORPHAN = 5;

class Cut {
  public:
    explicit Cut(const CutJob& job)
        : count(job.count),
          next(job.neighbours),
          back(4 * job.count),
          room(job.pair, job.pair + 4 * job.count),
          own(job.bias, job.bias + job.count),
          parent(job.count, NONE),
          tree(job.count, 0),
          queued(job.count, 0),
          stamp(job.count, 0),
          depth(job.count, 0) {
        for (int64_t i = 0; i < count; i++)
            for (int k = 0; k < 4; k++)
                if (const int32_t j = next[4 * i + k]; j >= 0)
                    for (int q = 0; q < 4; q++)
                        if (next[4 * (int64_t)j + q] == (int32_t)i) back[4 * i + k] = (uint8_t)q;
    }

    int64_t run() {
        for (int64_t i = 0; i < count; i++)
            if (own[i]) {
                tree[i] = own[i] < 0, parent[i] = ROOT, depth[i] = 1;
                activate((int32_t)i);
            }
        int32_t current = -1;
        for (;;) {
            if (current < 0 || parent[current] == NONE)
                if ((current = take()) < 0) return flow;
            const int found = grow(current);
            now++;
            if (found < 0) {
                current = -1;
                continue;
            }
            const int64_t arc = 4 * (int64_t)current + found;
            if (tree[current] == 0) {
                augment(current, found);
            } else {
                augment(next[arc], back[arc]);
            }
            while (!orphans.empty()) {
                const int32_t orphan = orphans.front();
                orphans.pop_front();
                adopt(orphan);
            }
        }
    }

    uint8_t side(int64_t i) const { return parent[i] != NONE && tree[i] == 1; }

  private:
    int64_t reverse(int64_t arc) const { return 4 * (int64_t)next[arc] + back[arc]; }

    // Room of an arc in the direction away from the root of a tree, from its parent's end.
    int32_t room_from(int64_t arc, int8_t which) const { return which == 0 ? room[arc] : room[reverse(arc)]; }
    int32_t room_to(int64_t arc, int8_t which) const { return which == 0 ? room[reverse(arc)] : room[arc]; }

    void activate(int32_t i) {
        if (queued[i]) return;
        queued[i] = 1, later.push_back(i);
    }

    int32_t take() {
        for (;;) {
            if (at == active.size()) {
                active.swap(later);
                later.clear(), at = 0;
                if (active.empty()) return -1;
            }
            const int32_t i = active[at++];
            queued[i] = 0;
            if (parent[i] != NONE) return i;
        }
    }

    // Take free neighbours into the tree of a node; the arc to one of the other tree, or -1.
    int grow(int32_t i) {
        const int8_t which = tree[i];
        for (int k = 0; k < 4; k++) {
            const int64_t arc = 4 * (int64_t)i + k;
            const int32_t j = next[arc];
            if (j < 0 || !(room_from(arc, which) > 0)) continue;
            if (parent[j] == NONE) {
                tree[j] = which, parent[j] = (int8_t)back[arc], stamp[j] = stamp[i], depth[j] = depth[i] + 1;
                activate(j);
            } else if (tree[j] != which) {
                return k;
            } else if (parent[j] != ROOT && stamp[j] <= stamp[i] && depth[j] > depth[i]) {
                parent[j] = (int8_t)back[arc], stamp[j] = stamp[i], depth[j] = depth[i] + 1;  // a shorter way
            }
        }
        return -1;
    }

    void disown(int32_t i, bool first) {
        parent[i] = ORPHAN;
        first ? orphans.push_front(i) : orphans.push_back(i);
    }

    // Send what fits along the path through an arc from the source's tree to the sink's.
    void augment(int32_t from, int k) {
        const int64_t bridge = 4 * (int64_t)from + k;
        const int32_t to = next[bridge];
        int64_t fits = room[bridge];
        for (int32_t i = from;;) {
            if (parent[i] == ROOT) {
                fits = std::min(fits, own[i]);
                break;
            }
            const int64_t arc = 4 * (int64_t)i + parent[i];
            fits = std::min<int64_t>(fits, room[reverse(arc)]), i = next[arc];
        }
        for (int32_t i = to;;) {
            if (parent[i] == ROOT) {
                fits = std::min(fits, -own[i]);
                break;
            }
            const int64_t arc = 4 * (int64_t)i + parent[i];
            fits = std::min<int64_t>(fits, room[arc]), i = next[arc];
        }
        const int32_t sent = (int32_t)fits;
        room[bridge] -= sent, room[reverse(bridge)] += sent;
        for (int32_t i = from;;) {
            if (parent[i] == ROOT) {
                if (!(own[i] -= fits)) disown(i, true);
                break;
            }
            const int64_t arc = 4 * (int64_t)i + parent[i];
            const int32_t up = next[arc];
            room[arc] += sent;
            if (!(room[reverse(arc)] -= sent)) disown(i, true);
            i = up;
        }
        for (int32_t i = to;;) {
            if (parent[i] == ROOT) {
                if (!(own[i] += fits)) disown(i, true);
                break;
            }
            const int64_t arc = 4 * (int64_t)i + parent[i];
            const int32_t up = next[arc];
            room[reverse(arc)] += sent;
            if (!(room[arc] -= sent)) disown(i, true);
            i = up;
        }
        flow += fits;
    }

    // Find a new parent, the nearest to the root, for a node that lost its own; else it is free.
    void adopt(int32_t i) {
        const int8_t which = tree[i];
        int best = -1;
        int32_t least = std::numeric_limits<int32_t>::max();
        for (int k = 0; k < 4; k++) {
            const int64_t arc = 4 * (int64_t)i + k;
            const int32_t j = next[arc];
            if (j < 0 || parent[j] == NONE || tree[j] != which || !(room_to(arc, which) > 0)) continue;
            const int32_t far = distance(j);
            if (far < least) least = far, best = k;
        }
        if (best >= 0) {
            parent[i] = (int8_t)best, stamp[i] = now, depth[i] = least + 1;
            return;
        }
        for (int k = 0; k < 4; k++) {
            const int64_t arc = 4 * (int64_t)i + k;
            const int32_t j = next[arc];
            if (j < 0 || parent[j] == NONE || tree[j] != which) continue;
            if (room_to(arc, which) > 0) activate(j);
            if (parent[j] != ROOT && parent[j] != ORPHAN && next[4 * (int64_t)j + parent[j]] == i) disown(j, false);
        }
        parent[i] = NONE;
    }

    // Nodes up to the root; the largest number if the way ends at an orphan.
    int32_t distance(int32_t i) {
        int32_t far = 0, j = i;
        for (;;) {
            if (stamp[j] == now) {
                far += depth[j];
                break;
            }
            far++;
            if (parent[j] == ROOT) {
                stamp[j] = now, depth[j] = 1;
                break;
            }
            if (parent[j] == ORPHAN || parent[j] == NONE) return std::numeric_limits<int32_t>::max();
            j = next[4 * (int64_t)j + parent[j]];
        }
        int32_t left = far;
        for (j = i; stamp[j] != now; j = next[4 * (int64_t)j + parent[j]]) stamp[j] = now, depth[j] = left--;
        return far;
    }

    int64_t count;
    const int32_t* next;
    std::vector<uint8_t> back;  // which arc of the neighbour leads back
    std::vector<int32_t> room;  // of each arc
    std::vector<int64_t> own;   // room from the source, or, negative, to the sink
    std::vector<int8_t> parent, tree;
    std::vector<uint8_t> queued;
    std::vector<int64_t> stamp;
    std::vector<int32_t> depth, active, later;
    std::deque<int32_t> orphans;
    size_t at = 0;
    int64_t now = 1;
    int64_t flow = 0;
};

}  // namespace

int64_t minimum_cut(const CutJob& job) {
    Cut cut(job);
    const int64_t flow = cut.run();
    for (int64_t i = 0; i < job.count; i++) job.side[i] = cut.side(i);
    return flow;
}

}  // namespace surfkit
