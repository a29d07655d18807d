// Choice of the instruction set, refusals, and calls from several threads at once.
#include <cstdlib>
#include <cstring>
#include <thread>
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::row_major;

void unknown_instruction_sets_are_refused() {
  const std::string message = refusal([] { controlmm::set_isa("mmx"); });
  CHECK(message.find("got 'mmx'") != std::string::npos);
  setenv("CONTROLMM_ISA", "sse9", 1);
  CHECK(refusal([] { controlmm::active_isa(); }).find("got 'sse9'") != std::string::npos);
  setenv("CONTROLMM_ISA", controlmm::available_isas().front().c_str(), 1);
  CHECK(controlmm::active_isa() == controlmm::available_isas().front());
}

void wrong_arguments_are_refused_by_name() {
  float features[2][70] = {}, joints[2][22][3] = {};
  const float constant[2][22][3] = {};
  const auto good = row_major(&features[0][0], {1, 2, 70});
  const auto text = [&](const controlmm::TensorView& in, const controlmm::TensorView& out) {
    return refusal([&] { controlmm::recover_joints(in, out); });
  };
  CHECK(text(row_major(&features[0][0], {2, 70}), row_major(&joints[0][0][0], {1, 2, 22, 3}))
            .find("`features` must have 3 dimensions, got shape (2, 70)") != std::string::npos);
  CHECK(text(row_major(&features[0][0], {1, 2, 60}), row_major(&joints[0][0][0], {1, 2, 22, 3}))
            .find("`features` must have at least 67 channels for 22 joints") != std::string::npos);
  CHECK(text(good, row_major(&joints[0][0][0], {1, 1, 22, 3})).find("`joints` must have shape (1, 2, 22, 3)") !=
        std::string::npos);
  CHECK(text(good, row_major(&constant[0][0][0], {1, 2, 22, 3})).find("`joints` must be writable") !=
        std::string::npos);
  auto misaligned = good;
  misaligned.data = reinterpret_cast<char*>(misaligned.data) + 1;
  CHECK(text(misaligned, row_major(&joints[0][0][0], {1, 2, 22, 3})).find("misaligned") != std::string::npos);
  auto overlapping = row_major(&features[0][0], {1, 2, 70});
  overlapping.strides[1] = 0;
  CHECK(refusal([&] {
          controlmm::recover_joints_backward(good, row_major(&joints[0][0][0], {1, 2, 22, 3}), overlapping);
        }).find("`grad_features` must not place two elements at one address") != std::string::npos);
}

void concurrent_callers_do_not_meet() {
  constexpr std::int64_t kClips = 40, kFrames = 100, kDim = 67;
  std::vector<float> features(kClips * kFrames * kDim, 0.01f);
  const auto view = row_major(features.data(), {kClips, kFrames, kDim});
  std::vector<std::vector<float>> results(4, std::vector<float>(kClips * kFrames * 66));
  std::vector<std::thread> callers;
  for (auto& result : results)
    callers.emplace_back(
        [&] { controlmm::recover_joints(view, row_major(result.data(), {kClips, kFrames, 22, 3}), 3); });
  for (std::thread& caller : callers) caller.join();
  for (const auto& result : results) CHECK(result == results.front());
}

}  // namespace

int main() {
  unknown_instruction_sets_are_refused();
  wrong_arguments_are_refused_by_name();
  concurrent_callers_do_not_meet();
}
