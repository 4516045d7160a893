// A pool of threads that lives as long as the process.
#pragma once

#include <cstdint>
#include <functional>

namespace surfkit {

// Run body(i) for 0 <= i < count on up to `threads` threads, the caller's included; returns when all are done. Which
// thread runs which i is not fixed: results must not depend on it. What a body throws is thrown again, once no thread
// works on it any more.
void parallel(int64_t count, int threads, const std::function<void(int64_t)>& body);

}  // namespace surfkit
