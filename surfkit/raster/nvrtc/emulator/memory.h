// Global and shared memory whose every access is checked: bounds, values that nobody wrote, and races.
#pragma once

#include "machine.h"

namespace emulator {

// The times are a vector clock per thread (Fiber::clocks): a lane's own time advances at every __syncwarp that it takes
// part in, and there it learns the times of the others. An access is remembered with the time of its thread, and is
// ordered before those of a thread that has learned of this time, and before everything behind a barrier of the block.

// Accesses by several threads of one block since its last barrier.
struct Crowd {
    int warp;  // -1: of several warps
    uint32_t clocks[kLanes];
};
inline std::vector<Crowd> crowds;

// The latest accesses of one kind to an element, as far as another access can still race with them.
struct Accesses {
    uint32_t epoch;  // of the last one; 0: none
    uint32_t clock;  // of its thread, or which crowd
    int16_t thread;  // -1: a crowd
    bool other_blocks;

    bool in_block() const { return epoch >= machine.block_start; }

    void add(bool is_global) {
        const Fiber& f = *machine.fiber;
        if (!in_block()) other_blocks = is_global && epoch != 0;
        if (epoch == machine.epoch && (thread < 0 || thread != f.rank)) {
            if (thread >= 0) {
                Crowd crowd = {machine.fibers[thread].warp, {}};
                crowd.clocks[thread % kLanes] = clock;
                thread = -1, clock = (uint32_t)crowds.size();
                crowds.push_back(crowd);
            }
            Crowd& crowd = crowds[clock];
            if (crowd.warp != f.warp) crowd.warp = -1;
            crowd.clocks[f.lane] = f.clocks[f.lane];
            return;
        }
        epoch = machine.epoch, thread = (int16_t)f.rank, clock = f.clocks[f.lane];
    }

    // Who could have done one of them at the same time as the running thread does something.
    enum Rival { kNobody, kThread, kBlock };
    Rival rival(bool is_global, int* who) const {
        if (!epoch || (!is_global && !in_block())) return kNobody;
        if (!in_block() || other_blocks) return kBlock;
        if (epoch < machine.epoch) return kNobody;
        const Fiber& f = *machine.fiber;
        if (thread >= 0) {
            *who = thread;
            if (thread == f.rank || (thread / kLanes == f.warp && f.clocks[thread % kLanes] >= clock)) return kNobody;
            return kThread;
        }
        const Crowd& crowd = crowds[clock];
        *who = -1;
        if (crowd.warp != f.warp) return kThread;
        for (int l = 0; l < kLanes; l++) {
            *who = f.warp * kLanes + l;
            if (l != f.lane && crowd.clocks[l] > f.clocks[l]) return kThread;
        }
        return kNobody;
    }
};

struct Record {
    Accesses writes, reads, atomics;
};

enum Access { kRead, kWrite, kAtomic };

// What Buffer and SHARED are: elements with a record of accesses to each, if races are to be found.
struct Memory {
    const char* name;
    long long size;
    Record* records;
    bool is_global;
    int bytes;  // of an element

    void check_bounds(long long i) const {
        if (++machine.accesses > kMostAccesses) fail("does not end: it is in a loop that reads or writes %s", name);
        if (i < 0 || i >= size) fail("index %lld of %s, which has %lld elements", i, name, size);
    }

    void race(long long i, Access access, const Accesses& past, const char* what) const {
        static const char* const verbs[] = {"reads", "writes", "changes atomically"};
        int who = -1;
        const Accesses::Rival rival = past.rival(is_global, &who);
        if (rival == Accesses::kNobody) return;
        char text[64] = "another thread of the block";
        if (rival == Accesses::kBlock)
            std::strcpy(text, "a thread of another block");
        else if (who >= 0)
            describe(text, sizeof text, machine.fibers[who]);
        fail("%s %s[%lld], which %s %s%s", verbs[access], name, i, text, what,
             rival == Accesses::kBlock ? " in the same launch" : " with no barrier between");
    }

    void note(long long i, Access access) const {
        (is_global ? machine.work.global_bytes : machine.work.shared_bytes)[access] += bytes;
        if (!records) return;
        Record& r = records[i];
        if (!is_global && access != kWrite && !r.writes.in_block() && !r.atomics.in_block())
            fail("reads %s[%lld], which no thread of the block has written", name, i);
        race(i, access, r.writes, "writes");
        if (access != kAtomic) race(i, access, r.atomics, "changes atomically");
        if (access != kRead) race(i, access, r.reads, "reads");
        (access == kRead ? r.reads : access == kWrite ? r.writes : r.atomics).add(is_global);
    }
};

// The address of an element, for atomics.
template <class T>
struct Pointer {
    const Memory* memory;
    T* data;
    long long index;
    T& change() const {
        memory->note(index, kAtomic);
        return data[index];
    }
};

// What x[i] gives: tells reading from writing.
template <class T>
struct Element {
    const Memory* memory;
    T* data;
    long long index;

    operator T() const {
        memory->note(index, kRead);
        return data[index];
    }
    Element& operator=(const T& value) {
        memory->note(index, kWrite);
        data[index] = value;
        return *this;
    }
    Element& operator=(const Element& other) { return *this = (T)other; }
    Element(const Element&) = default;
    Element(const Memory* m, T* d, long long i) : memory(m), data(d), index(i) {}
    Pointer<T> operator&() const { return {memory, data, index}; }

#define EMULATOR_ASSIGN(op)                         \
    template <class U>                              \
    Element& operator op## = (const U& value) {     \
        return *this = (T)((T) * this op(T) value); \
    }
    EMULATOR_ASSIGN(+)
    EMULATOR_ASSIGN(-)
    EMULATOR_ASSIGN(*)
    EMULATOR_ASSIGN(/)
    EMULATOR_ASSIGN(|)
    EMULATOR_ASSIGN(&)
    EMULATOR_ASSIGN(^)
    EMULATOR_ASSIGN(<<)
    EMULATOR_ASSIGN(>>)
#undef EMULATOR_ASSIGN
    Element& operator++() { return *this = (T)((T) * this + 1); }
    Element& operator--() { return *this = (T)((T) * this - 1); }
    T operator++(int) {
        const T before = *this;
        *this = (T)(before + 1);
        return before;
    }
};

template <class T>
struct Array : Memory {
    T* data;
    Element<T> operator[](long long i) const {
        check_bounds(i);
        return {this, data, i};
    }
};
template <class T>
struct Array<const T> : Memory {
    const T* data;
    T operator[](long long i) const {
        check_bounds(i);
        note(i, kRead);
        return data[i];
    }
};

// Every launch of a block finds its shared memory unwritten, as the records belong to blocks before.
template <class T, int kSize>
struct SharedStorage : Array<T> {
    T values[kSize];
    Record all[kSize] = {};
    explicit SharedStorage(const char* name) {
        this->name = name, this->size = kSize, this->records = all, this->is_global = false, this->bytes = sizeof(T),
        this->data = values;
    }
};

// Records of the buffers of one launch, by their address: arguments of the same memory share them.
inline std::map<const void*, Record*> globals;

inline void make_records(const void* data, long long size) {
    Record*& records = globals[data];
    if (!records) records = (Record*)std::calloc(size, sizeof(Record));
    if (!records) throw std::bad_alloc();
}

inline void free_records() {
    for (auto& each : globals) std::free(each.second);
    globals.clear();
}

}  // namespace emulator

template <class T>
using Buffer = emulator::Array<T>;
template <class T>
using SharedArray = const emulator::Array<T>&;
#define SHARED(T, name, count)                                         \
    static emulator::SharedStorage<T, (count)> name##_of_block(#name); \
    SharedArray<T> name = name##_of_block
