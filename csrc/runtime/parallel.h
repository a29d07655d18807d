#pragma once

#include <cstdint>
#include <functional>

#include "kernel_table.h"

namespace controlmm {

/// Clips that a call splits into, so that each thread has at least `kSmallestShareNs` of work.
/// @param work_ns Estimated time of the whole call in one thread.
int useful_threads(int threads, std::int64_t clips, double work_ns);

/// Runs `work(range, worker)` over all clips: in the caller if `workers` is 1, else with workers - 1 threads of its
/// own, which take small ranges in turn: a thread that the system starts late delays nobody. Threads live for one call
/// only, so there is nothing that a fork could leave behind. `work` must not throw, and must not depend on how the
/// clips are cut into ranges.
void for_clip_ranges(std::int64_t clips, int workers, const std::function<void(ClipRange, int)>& work);

}  // namespace controlmm
