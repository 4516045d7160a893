// Uninitialised memory for one pass. Large pieces ask for huge pages: records are read in the order of a tile, which is
// far from theirs in memory, and with small pages every read would also miss the translation cache.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace surfkit {

struct Free {
    void operator()(void* p) const { std::free(p); }
};
template <class T>
using Buffer = std::unique_ptr<T[], Free>;

template <class T>
Buffer<T> buffer(int64_t count) {
    const size_t bytes = (size_t)count * sizeof(T), huge = 2 << 20;
    const size_t align = bytes >= 2 * huge ? huge : 64;
    void* const p = std::aligned_alloc(align, (bytes / align + 1) * align);
    if (!p) throw std::bad_alloc();
#if defined(__linux__)
    if (align == huge) madvise(p, bytes, MADV_HUGEPAGE);
#endif
    return Buffer<T>((T*)p);
}

}  // namespace surfkit
