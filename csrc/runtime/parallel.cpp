#include "parallel.h"

#include <algorithm>
#include <system_error>
#include <thread>
#include <vector>

namespace controlmm {
namespace {

// Starting and joining a thread costs about 12 us; below this share it is not worth it.
constexpr double kSmallestShareNs = 150e3;

ClipRange share_of(std::int64_t clips, int workers, int worker) {
  return {clips * worker / workers, clips * (worker + 1) / workers};
}

}  // namespace

int useful_threads(int threads, std::int64_t clips, double work_ns) {
  const double by_work = work_ns / kSmallestShareNs;
  const std::int64_t most = std::min<std::int64_t>(threads, clips);
  return static_cast<int>(std::clamp<std::int64_t>(static_cast<std::int64_t>(std::min(by_work, 4096.0)), 1,
                                                   std::max<std::int64_t>(most, 1)));
}

void for_clip_ranges(std::int64_t clips, int workers, const std::function<void(ClipRange, int)>& work) {
  std::vector<std::thread> threads;
  threads.reserve(static_cast<std::size_t>(workers - 1));
  int started = 1;
  try {
    for (; started < workers; ++started)
      threads.emplace_back([&work, clips, workers, started] { work(share_of(clips, workers, started), started); });
  } catch (const std::system_error&) {
    // The system gives no more threads: the caller does the remaining shares itself.
  }
  work(share_of(clips, workers, 0), 0);
  for (int worker = started; worker < workers; ++worker) work(share_of(clips, workers, worker), worker);
  for (std::thread& thread : threads) thread.join();
}

}  // namespace controlmm
