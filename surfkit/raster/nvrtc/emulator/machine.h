// A CUDA block on one CPU core: every thread is a fiber, which runs until it waits at a barrier or for its warp.
#pragma once

#include <sys/mman.h>

#include <cmath>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <new>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#if !defined(__x86_64__)
#define EMULATED_UCONTEXT
#endif
#ifdef EMULATED_UCONTEXT
#include <ucontext.h>
#endif

struct uint3 {
    unsigned x, y, z;
};
using dim3 = uint3;

namespace emulator {

constexpr int kMaxThreads = 1024, kLanes = 32;
constexpr long kMostAccesses = 1 << 25;  // of one thread between two barriers
constexpr size_t kStack = 256 << 10, kPage = 4096;

// ---- switching between fibers

#ifdef EMULATED_UCONTEXT
using Context = ucontext_t;
inline void switch_context(Context& from, Context& to) { swapcontext(&from, &to); }
inline void start_context(Context& c, char* stack, void (*entry)()) {
    getcontext(&c);
    c.uc_stack.ss_sp = stack;
    c.uc_stack.ss_size = kStack - kPage;
    c.uc_link = nullptr;
    makecontext(&c, entry, 0);
}
#else
// The registers that a call preserves, on the stack whose pointer is kept.
using Context = void*;
extern "C" __attribute__((visibility("hidden"))) void emulator_switch(void** from, void* to);
asm(R"(
    .text
    .hidden emulator_switch
    .globl emulator_switch
    .type emulator_switch, @function
emulator_switch:
    pushq %rbp
    pushq %rbx
    pushq %r12
    pushq %r13
    pushq %r14
    pushq %r15
    movq %rsp, (%rdi)
    movq %rsi, %rsp
    popq %r15
    popq %r14
    popq %r13
    popq %r12
    popq %rbx
    popq %rbp
    ret
    .size emulator_switch, .-emulator_switch
)");
inline void switch_context(Context& from, Context& to) { emulator_switch(&from, to); }
inline void start_context(Context& c, char* stack, void (*entry)()) {
    void** top = (void**)(stack + kStack - kPage);
    *--top = nullptr;  // where `entry` would return to, and the alignment that a function expects
    *--top = (void*)entry;
    for (int i = 0; i < 6; i++) *--top = nullptr;
    c = top;
}
#endif

// ---- one block

// What the lanes of a warp, or the threads of a block, do together.
struct Operation {
    const char* name;
    enum Kind { kShuffle, kVote, kReduce, kOrder, kBarrier } kind;
    uint64_t (*combine)(uint64_t, uint64_t);
};

struct Fiber {
    uint3 index;
    int rank, lane, warp;
    enum State { kReady, kWaiting, kDone } state;
    const Operation* operation;  // that it waits in
    unsigned mask;
    uint64_t value, result;
    int argument, line;
    uint32_t clocks[kLanes];  // of each lane, the last of its times that is ordered before now; see Accesses
    Context context;
};

// What a launch did; the same fields in the same order as `Work` of emulated.py.
struct Work {
    long long global_bytes[3], shared_bytes[3];  // read, written, changed atomically; as asked for, caches aside
    long long collectives, barriers;             // per warp, per block
    long long warps;
};

struct Machine {
    const char* kernel;
    uint3 grid, block_size, block;
    int threads;
    std::vector<Fiber> fibers;
    std::vector<int> order;
    char* stacks = nullptr;
    Fiber* fiber;     // that runs
    long accesses;    // to memory, since it went on
    Context scheduler;
    void (*body)(void*);
    void* closure;
    int arrived;                  // at the barrier of the block
    uint32_t epoch, block_start;  // counts barriers over all blocks; its value when this block began
    void (*new_epoch)();
    Work work;
    char error[1024];
};
inline Machine machine;

inline void describe(char* text, size_t size, const Fiber& f) {
    std::snprintf(text, size, "thread (%u, %u, %u)", f.index.x, f.index.y, f.index.z);
}

// Ends the launch: says what the running thread did wrong, and never returns.
[[noreturn]] __attribute__((format(printf, 1, 2))) inline void fail(const char* format, ...) {
    Machine& m = machine;
    const Fiber& f = *m.fiber;
    int n = std::snprintf(m.error, sizeof m.error, "kernel %s, block (%u, %u, %u), thread (%u, %u, %u): ", m.kernel,
                          m.block.x, m.block.y, m.block.z, f.index.x, f.index.y, f.index.z);
    va_list rest;
    va_start(rest, format);
    std::vsnprintf(m.error + n, sizeof m.error - n, format, rest);
    va_end(rest);
    switch_context(m.fiber->context, m.scheduler);
    std::abort();
}

inline void wait() {
    machine.fiber->state = Fiber::kWaiting;
    switch_context(machine.fiber->context, machine.scheduler);
}

inline void run_fiber() {
    machine.body(machine.closure);
    machine.fiber->state = Fiber::kDone;
    switch_context(machine.fiber->context, machine.scheduler);
}

inline bool same_call(const Fiber& a, const Fiber& b) {
    return a.state == Fiber::kWaiting && a.operation == b.operation && a.mask == b.mask && a.line == b.line;
}

// No thread can run, but not all are done: names one that waits and one that does not come.
inline void report_divergence() {
    Machine& m = machine;
    for (Fiber& f : m.fibers) {
        if (f.state != Fiber::kWaiting) continue;
        for (const Fiber& other : m.fibers) {
            const bool awaited =
                f.operation->kind == Operation::kBarrier || (other.warp == f.warp && (f.mask >> other.lane & 1));
            if (!awaited || same_call(other, f)) continue;
            char who[64], what[128] = "has returned";
            describe(who, sizeof who, other);
            if (other.state == Fiber::kWaiting)
                std::snprintf(what, sizeof what, "waits in %s of line %d with mask %08x", other.operation->name,
                              other.line, other.mask);
            std::snprintf(m.error, sizeof m.error,
                          "kernel %s, block (%u, %u, %u), thread (%u, %u, %u): waits in %s of line %d for %s, which %s",
                          m.kernel, m.block.x, m.block.y, m.block.z, f.index.x, f.index.y, f.index.z, f.operation->name,
                          f.line, who, what);
            return;
        }
    }
}

inline void run_block() {
    Machine& m = machine;
    m.block_start = ++m.epoch;
    m.new_epoch();
    m.arrived = 0;
    m.work.warps += (m.threads + kLanes - 1) / kLanes;
    for (int i = 0; i < m.threads; i++) {
        Fiber& f = m.fibers[i];
        f.state = Fiber::kReady;
        std::memset(f.clocks, 0, sizeof f.clocks);
        f.clocks[f.lane] = 1;
        start_context(f.context, m.stacks + i * kStack + kPage, run_fiber);
    }
    for (int left = m.threads; left > 0;) {
        bool moved = false;
        for (int i : m.order) {
            m.fiber = &m.fibers[i];
            if (m.fiber->state != Fiber::kReady) continue;
            moved = true;
            m.accesses = 0;
            switch_context(m.scheduler, m.fiber->context);
            if (m.error[0]) return;
            left -= m.fiber->state == Fiber::kDone;
        }
        if (!moved) return report_divergence();
    }
}

// ---- meetings of threads

// Waits for all lanes of the mask; what this lane gets of it.
inline uint64_t meet(const Operation& operation, unsigned mask, uint64_t value, int argument, int line) {
    Machine& m = machine;
    Fiber& f = *m.fiber;
    Fiber* const warp = &m.fibers[f.warp * kLanes];
    if (!(mask >> f.lane & 1)) fail("%s of line %d with mask %08x lacks its own lane", operation.name, line, mask);
    f.operation = &operation, f.mask = mask, f.value = value, f.argument = argument, f.line = line;
    for (int l = 0; l < kLanes; l++) {
        if (!(mask >> l & 1) || l == f.lane) continue;
        if (f.warp * kLanes + l >= m.threads)
            fail("%s of line %d with mask %08x, but the block has no thread in lane %d", operation.name, line, mask, l);
        if (warp[l].state == Fiber::kDone || !same_call(warp[l], f)) {
            wait();  // the last to come does what follows, and this one is ready again
            return f.result;
        }
    }
    m.work.collectives++;
    uint64_t all = 0;
    bool first = true;
    uint32_t clocks[kLanes] = {};
    for (int l = 0; l < kLanes; l++) {
        if (!(mask >> l & 1)) continue;
        Fiber& w = warp[l];
        switch (operation.kind) {
            case Operation::kShuffle:
                if (!(mask >> w.argument & 1)) {
                    m.fiber = &w;
                    fail("%s of line %d reads lane %d, which is not in its mask %08x", operation.name, line, w.argument,
                         mask);
                }
                w.result = warp[w.argument].value;
                break;
            case Operation::kVote:
                all |= (uint64_t)(w.value != 0) << l;
                break;
            case Operation::kReduce:
                all = first ? w.value : operation.combine(all, w.value);
                first = false;
                break;
            default:
                for (int i = 0; i < kLanes; i++) clocks[i] = clocks[i] > w.clocks[i] ? clocks[i] : w.clocks[i];
        }
    }
    for (int l = 0; l < kLanes; l++) {
        if (!(mask >> l & 1)) continue;
        Fiber& w = warp[l];
        w.state = Fiber::kReady;
        if (operation.kind != Operation::kShuffle) w.result = all;
        if (operation.kind == Operation::kOrder) {
            std::memcpy(w.clocks, clocks, sizeof clocks);
            w.clocks[l]++;
        }
    }
    return f.result;
}

// Waits for all threads of the block; the sum of their values.
inline int barrier(const Operation& operation, int value, int line) {
    Machine& m = machine;
    Fiber& f = *m.fiber;
    f.operation = &operation, f.mask = 0, f.value = value, f.line = line;
    if (++m.arrived < m.threads) {
        wait();
        return (int)f.result;
    }
    m.work.barriers++;
    f.state = Fiber::kWaiting;
    int sum = 0;
    for (const Fiber& other : m.fibers) {
        if (!same_call(other, f)) {
            char who[64];
            describe(who, sizeof who, other);
            fail("arrives at %s of line %d, but %s waits in %s of line %d", operation.name, line, who,
                 other.operation->name, other.line);
        }
        sum += (int)other.value;
    }
    for (Fiber& other : m.fibers) other.state = Fiber::kReady, other.result = sum;
    m.arrived = 0;
    m.epoch++;
    m.new_epoch();
    return sum;
}

// ---- launches

// A permutation of 0 .. count - 1; the identity for seed 0.
inline std::vector<long long> permutation(long long count, uint64_t seed) {
    std::vector<long long> out(count);
    for (long long i = 0; i < count; i++) out[i] = i;
    if (!seed) return out;
    for (long long i = count - 1; i > 0; i--) {
        seed = seed * 6364136223846793005u + 1442695040888963407u;
        std::swap(out[i], out[(seed >> 33) % (i + 1)]);
    }
    return out;
}

// The stacks of fibers. All libraries of a process share one, as each guarded stack takes two of the mappings that the
// system allows a process (65,530 on Linux).
struct Stacks {
    char* memory;
    int guarded;  // stacks that end with a page that nobody may touch

    // Whether so many threads have theirs.
    bool prepare(int threads) {
        if (!memory) {
            void* made = mmap(nullptr, kMaxThreads * kStack, PROT_READ | PROT_WRITE,
                              MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
            if (made == MAP_FAILED) return false;
            memory = (char*)made;
        }
        for (; guarded < threads; guarded++)
            if (mprotect(memory + guarded * kStack, kPage, PROT_NONE)) return false;
        return true;
    }
};

inline void run_grid(const char* kernel, const unsigned* grid, const unsigned* block, uint64_t seed, Stacks& stacks) {
    Machine& m = machine;
    m.kernel = kernel, m.grid = {grid[0], grid[1], grid[2]}, m.block_size = {block[0], block[1], block[2]};
    m.threads = block[0] * block[1] * block[2];
    m.fibers.assign(m.threads, Fiber());
    for (int i = 0; i < m.threads; i++) {
        Fiber& f = m.fibers[i];
        f.rank = i, f.lane = i % kLanes, f.warp = i / kLanes;
        f.index = {i % block[0], i / block[0] % block[1], i / (block[0] * block[1])};
    }
    if (!stacks.prepare(m.threads)) {
        std::snprintf(m.error, sizeof m.error, "kernel %s: no memory for the stacks of %d threads", kernel, m.threads);
        return;
    }
    m.stacks = stacks.memory;
    const std::vector<long long> order = permutation(m.threads, seed);
    m.order.assign(order.begin(), order.end());
    for (long long i : permutation((long long)grid[0] * grid[1] * grid[2], seed)) {
        m.block = {(unsigned)(i % grid[0]), (unsigned)(i / grid[0] % grid[1]), (unsigned)(i / grid[0] / grid[1])};
        run_block();
        if (m.error[0]) return;
    }
}

}  // namespace emulator

#define threadIdx (emulator::machine.fiber->index)
#define blockIdx (emulator::machine.block)
#define blockDim (emulator::machine.block_size)
#define gridDim (emulator::machine.grid)
constexpr int warpSize = 32;
