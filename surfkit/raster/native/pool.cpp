#include "pool.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

namespace surfkit {
namespace {

// The first throw on a thread reserves memory for it; where memory has just given out that fails, and the C library ends
// the process. So it is reserved before a body runs. (volatile: else the compiler leaves the call out.)
void be_ready_to_throw() {
    volatile const int reserved = std::uncaught_exceptions();
    (void)reserved;
}

struct Job {
    const std::function<void(int64_t)>* body;
    int64_t count;
    std::atomic<int64_t> next{0};
    std::atomic<int> running{0};
    int wanted = 0;  // helpers still to join, guarded by the pool's lock
    std::mutex failing;
    std::exception_ptr failure;  // the first one, such as of memory that gave out; what is left is not begun then

    void work() {
        try {
            for (int64_t i; (i = next.fetch_add(1)) < count;) (*body)(i);
        } catch (...) {
            next = count;
            std::lock_guard<std::mutex> lock(failing);
            if (!failure) failure = std::current_exception();
        }
    }
};

class Pool {
  public:
    void run(int64_t count, int helpers, const std::function<void(int64_t)>& body) {
        std::lock_guard<std::mutex> one_at_a_time(caller_);
        be_ready_to_throw();
        Job job;
        job.body = &body;
        job.count = count;
        {
            std::unique_lock<std::mutex> lock(mutex_);
            try {
                while ((int)threads_.size() < helpers) threads_.emplace_back([this] { serve(); });
            } catch (const std::exception&) {  // no memory for one more: those that are there do the work
            }
            done_.wait(lock, [&] { return ready_ == threads_.size(); });
            job.wanted = std::min(helpers, (int)threads_.size());
            job_ = &job;
        }
        wake_.notify_all();
        job.work();
        std::unique_lock<std::mutex> lock(mutex_);
        job_ = nullptr;  // whoever has not joined yet need not
        done_.wait(lock, [&] { return job.running.load() == 0; });
        if (job.failure) std::rethrow_exception(job.failure);
    }

  private:
    void serve() {
        be_ready_to_throw();
        std::unique_lock<std::mutex> lock(mutex_);
        ready_++;
        done_.notify_all();
        for (;;) {
            wake_.wait(lock, [&] { return job_ && job_->wanted > 0; });
            Job* job = job_;
            job->wanted--;
            job->running++;
            lock.unlock();
            job->work();
            lock.lock();
            if (--job->running == 0) done_.notify_all();
        }
    }

    std::mutex caller_, mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> threads_;
    size_t ready_ = 0;  // of them
    Job* job_ = nullptr;
};

// Never destroyed: its threads may outlive static destructors. A forked child has no threads, so it gets a new pool.
Pool* pool = nullptr;

Pool& the_pool() {
    static const bool once = [] {
        pool = new Pool;
#if defined(__unix__) || defined(__APPLE__)
        pthread_atfork(nullptr, nullptr, [] { pool = new Pool; });
#endif
        return true;
    }();
    (void)once;
    return *pool;
}

}  // namespace

void parallel(int64_t count, int threads, const std::function<void(int64_t)>& body) {
    if (threads <= 1 || count <= 1) {
        for (int64_t i = 0; i < count; i++) body(i);
        return;
    }
    the_pool().run(count, (int)(threads - 1 < count - 1 ? threads - 1 : count - 1), body);
}

}  // namespace surfkit
