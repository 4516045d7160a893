// The minimum cut of a graph of tetrahedra: see mesh/visibility.py.
#pragma once

#include <cstdint>

namespace surfkit {

struct CutJob {
    int64_t count;              // of tetrahedra
    const int32_t* neighbours;  // (count, 4); -1 for none
    const int32_t* pair;        // (count, 4) what it costs if a neighbour is on the other side; the same seen from there
    const int64_t* bias;        // (count,) what it costs to be on side 1; negative: to be on side 0
    uint8_t* side;              // (count,) to be written: 0 or 1, and 0 where both cost the same
};

// The sides that cost least in all; returns the flow, which is that cost above the least that biases alone allow.
int64_t minimum_cut(const CutJob& job);

}  // namespace surfkit
