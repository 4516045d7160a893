// Runs CUDA C++ kernels on one CPU core and finds their mistakes: an access out of bounds, a race, shared memory read
// before it is written, threads that do not arrive at a barrier. See prelude.h for what kernels may use.
#pragma once

#include "intrinsics.h"

namespace emulator {

// Arguments come as the CUDA driver takes them: a pointer to each.
template <class T>
struct Argument {
    static constexpr long long kSize = sizeof(T);
    static void announce(const void*) {}
    static T read(const void* at, const char*) { return *(const T*)at; }
};
template <class T>
struct Plain {
    T* data;
    long long size;
};
template <class T>
struct Argument<Array<T>> {
    static constexpr long long kSize = sizeof(T);  // of an element
    static Array<T> read(const void* at, const char* name) {
        const Plain<T> plain = *(const Plain<T>*)at;
        Array<T> out;
        out.name = name, out.size = plain.size, out.is_global = true, out.bytes = sizeof(T), out.data = plain.data;
        const auto found = globals.find(plain.data);
        out.records = found == globals.end() ? nullptr : found->second;
        return out;
    }
    // Only what a kernel may write can be raced for, also where it is an input too.
    static void announce(const void* at) {
        const Plain<T> plain = *(const Plain<T>*)at;
        if (!std::is_const<T>::value && plain.size) make_records(plain.data, plain.size);
    }
};

template <class... A>
struct Call {
    void (*kernel)(A...);
    std::tuple<A...> arguments;
    static void run(void* self) {
        Call& c = *(Call*)self;
        std::apply(c.kernel, c.arguments);
    }
};

template <class... A, size_t... I>
void launch(void (*kernel)(A...), void** arguments, const char* const* names, std::index_sequence<I...>) {
    static Call<A...> call;
    (Argument<A>::announce(arguments[I]), ...);
    call = {kernel, std::tuple<A...>(Argument<A>::read(arguments[I], names[I])...)};
    machine.body = Call<A...>::run;
    machine.closure = &call;
}
template <class... A>
void prepare(void (*kernel)(A...), void** arguments, const char* const* names) {
    launch(kernel, arguments, names, std::index_sequence_for<A...>());
}
template <class... A>
int sizes(void (*)(A...), long long* out) {
    const long long all[] = {Argument<A>::kSize..., 0};
    for (size_t i = 0; i < sizeof...(A); i++) out[i] = all[i];
    return (int)sizeof...(A);
}

}  // namespace emulator

// Everything else is hidden: libraries of several sources, each with its own machine, are loaded into one process.
#define EMULATOR_EXPORT extern "C" __attribute__((visibility("default")))

// For each kernel, written by emulated.py behind the source: how to read its arguments, and how large they are.
#define EMULATED_KERNEL(kernel, ...)                               \
    EMULATOR_EXPORT void emulated_##kernel(void** arguments) {     \
        static const char* const names[] = {__VA_ARGS__, nullptr}; \
        emulator::prepare(kernel, arguments, names);               \
    }                                                              \
    EMULATOR_EXPORT int emulated_sizes_##kernel(long long* out) { return emulator::sizes(kernel, out); }

// What the last launch did.
EMULATOR_EXPORT void emulated_work(emulator::Work* out) { *out = emulator::machine.work; }

// Runs a kernel; what went wrong, or an empty text.
EMULATOR_EXPORT const char* emulated_launch(const char* name, void (*prepare)(void**), void** arguments,
                                            const unsigned* grid, const unsigned* block, unsigned long long seed,
                                            emulator::Stacks* stacks) {
    emulator::machine.error[0] = 0;
    emulator::machine.work = {};
    emulator::machine.new_epoch = [] { emulator::crowds.clear(); };
    prepare(arguments);
    emulator::run_grid(name, grid, block, seed, *stacks);
    emulator::free_records();
    return emulator::machine.error;
}
