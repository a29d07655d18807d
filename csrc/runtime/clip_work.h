#pragma once

#include <memory>

#include "parallel.h"

namespace controlmm {

/// Runs `work(range, scratch)` over all clips, each thread with its own scratch of that many doubles.
template <class Work>
void run_over_clips(std::int64_t clips, double work_ns, int threads, std::int64_t scratch_doubles, Work work) {
  const int workers = useful_threads(threads, clips, work_ns);
  const auto share = static_cast<std::size_t>(scratch_doubles);
  // Allocated here: nothing may throw inside a thread.
  const std::unique_ptr<double[]> scratch(new double[share * static_cast<std::size_t>(workers)]);
  if (workers == 1) return work(ClipRange{0, clips}, scratch.get());
  for_clip_ranges(clips, workers, [&](ClipRange range, int worker) {
    work(range, scratch.get() + share * static_cast<std::size_t>(worker));
  });
}

}  // namespace controlmm
