#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <memory>
#include <system_error>
#include <thread>

namespace controlmm {
namespace {

// A thread begins about 45 us after it was started, on a busy machine milliseconds; below this share of the work it
// is not worth it.
constexpr double kSmallestShareNs = 150e3;
constexpr int kChunksPerWorker = 4;  // so that a worker that began late, or on a slow core, takes fewer

// What is left of a call's work. The caller and its threads take chunks of clips until none is left. It may outlive the
// call: a thread that begins after all is done finds no chunk, and never touches `work`.
class Chunks {
 public:
  Chunks(std::int64_t clips, int count, const std::function<void(ClipRange, int)>& work)
      : clips_(clips), count_(count), work_(&work) {}

  void take_all(int worker) {
    for (int chunk = next_.fetch_add(1); chunk < count_; chunk = next_.fetch_add(1)) {
      (*work_)({clips_ * chunk / count_, clips_ * (chunk + 1) / count_}, worker);
      done_.fetch_add(1, std::memory_order_release);
    }
  }

  // The last chunks are a small part of the call, so sleeping would take longer than they do.
  void wait() const {
    while (done_.load(std::memory_order_acquire) < count_) std::this_thread::yield();
  }

 private:
  const std::int64_t clips_;
  const int count_;
  const std::function<void(ClipRange, int)>* const work_;
  std::atomic<int> next_{0}, done_{0};
};

}  // namespace

int useful_threads(int threads, std::int64_t clips, double work_ns) {
  const double by_work = work_ns / kSmallestShareNs;
  const std::int64_t most = std::min<std::int64_t>(threads, clips);
  return static_cast<int>(std::clamp<std::int64_t>(static_cast<std::int64_t>(std::min(by_work, 4096.0)), 1,
                                                   std::max<std::int64_t>(most, 1)));
}

void for_clip_ranges(std::int64_t clips, int workers, const std::function<void(ClipRange, int)>& work) {
  const int count = static_cast<int>(std::min<std::int64_t>(clips, std::int64_t{workers} * kChunksPerWorker));
  const auto chunks = std::make_shared<Chunks>(clips, count, work);
  try {
    for (int worker = 1; worker < workers; ++worker)
      std::thread([chunks, worker] { chunks->take_all(worker); }).detach();
  } catch (const std::system_error&) {
    // The system gives no more threads: those that there are, and the caller, do everything.
  }
  chunks->take_all(0);
  chunks->wait();
}

}  // namespace controlmm
