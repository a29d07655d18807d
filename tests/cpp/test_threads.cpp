// Every operator with enough clips for several threads: the same bits as with one. The thread sanitizer runs this too.
#include <functional>
#include <memory>
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::row_major;
constexpr std::int64_t kClips = 48, kFrames = 60, kJoints = 22, kDim = 67;

std::vector<float> wave(std::int64_t n, float step) {
  std::vector<float> values(static_cast<std::size_t>(n));
  for (std::size_t i = 0; i < values.size(); ++i)
    values[i] = 0.4f * std::sin(0.3f + step * static_cast<float>(i % 9973));
  return values;
}

// Runs `work(threads, outputs)` with one and with four threads and compares what it wrote.
void same_bits(std::vector<std::int64_t> sizes,
               const std::function<void(int, std::vector<std::vector<float>>&)>& work) {
  std::vector<std::vector<float>> alone, many;
  for (std::int64_t size : sizes) {
    alone.emplace_back(static_cast<std::size_t>(size));
    many.emplace_back(static_cast<std::size_t>(size));
  }
  work(1, alone);
  work(4, many);
  CHECK(alone == many);
}

struct Scene {
  std::int64_t kinds[3][4] = {{0, 0, 0, 0}, {1, 0, 0, 0}, {4, 0, 0, 0}};
  float parameters[3][controlmm::kObstacleParameters] = {
      {0.1f, 0.2f, 0.3f, 0.5f}, {-1, 0, 0, 1, 0.2f, 0.1f, 0.3f}, {0, 1, 0, 0.1f}};
  float radii[kJoints] = {}, heights[1] = {0};
  std::unique_ptr<bool[]> is_active{new bool[kJoints]};
  std::vector<std::int64_t> lengths = std::vector<std::int64_t>(kClips, kFrames - 3);

  Scene() {
    for (std::int64_t j = 0; j < kJoints; ++j) is_active[static_cast<std::size_t>(j)] = j % 2 == 0;
  }
  controlmm::Obstacles obstacles() const {
    return {row_major(&kinds[0][0], {3, 4}), row_major(&parameters[0][0], {1, 3, controlmm::kObstacleParameters, 1}),
            row_major(heights, {0})};
  }
  controlmm::Clearance clearance() const {
    return {row_major(radii, {kJoints}), row_major(is_active.get(), {kJoints}), row_major(lengths.data(), {kClips}),
            0.05, true};
  }
};

void losses() {
  const Scene scene;
  const std::vector<float> joints = wave(kClips * kFrames * kJoints * 3, 0.7f),
                           decoded = wave(kClips * kDim * kFrames, 0.3f);
  const std::vector<float> targets = wave(kClips * kFrames * kJoints * 3, 0.9f), mean = wave(kDim, 0.2f),
                           std = wave(kDim, 0.1f);
  const std::unique_ptr<bool[]> mask(new bool[joints.size()]);
  for (std::size_t i = 0; i < joints.size(); ++i) mask[i] = i % 5 < 3;
  const auto at = row_major(joints.data(), {kClips, kFrames, kJoints, 3});
  const auto wanted = row_major(targets.data(), {kClips, kFrames, kJoints, 3});
  const auto where = row_major(mask.get(), {kClips, kFrames, kJoints, 3});
  const std::int64_t values = kClips * kFrames * kJoints * 3;
  same_bits({kClips, values}, [&](int threads, std::vector<std::vector<float>>& out) {
    const auto loss = row_major(out[0].data(), {kClips});
    std::vector<double> counts(kClips);
    const auto count = row_major(counts.data(), {kClips});
    controlmm::masked_consistency_loss(at, wanted, where, controlmm::Norm::l2, loss, count, threads);
    controlmm::masked_consistency_loss_backward(at, wanted, where, controlmm::Norm::l2, loss, count,
                                                row_major(out[1].data(), {kClips, kFrames, kJoints, 3}), threads);
  });
  same_bits({kClips, values}, [&](int threads, std::vector<std::vector<float>>& out) {
    const auto loss = row_major(out[0].data(), {kClips});
    controlmm::obstacle_loss(at, scene.obstacles(), scene.clearance(), loss, threads);
    controlmm::obstacle_loss_backward(at, scene.obstacles(), scene.clearance(), loss,
                                      row_major(out[1].data(), {kClips, kFrames, kJoints, 3}), threads);
  });
  same_bits({kClips, kClips * kDim * kFrames}, [&](int threads, std::vector<std::vector<float>>& out) {
    controlmm::guidance_value_and_grad(
        row_major(decoded.data(), {kClips, kDim, kFrames}), row_major(mean.data(), {kDim}),
        row_major(std.data(), {kDim}), wanted, where, controlmm::Norm::l1, scene.obstacles(), scene.clearance(), 0.5,
        row_major(out[0].data(), {kClips}), row_major(out[1].data(), {kClips, kDim, kFrames}), threads);
  });
}

void gumbel() {
  constexpr std::int64_t kTokens = 12, kCodes = 512, kChannels = 8, kRows = kClips * kTokens;
  const std::vector<float> logits = wave(kRows * kCodes, 0.7f), codebook = wave(kCodes * kChannels, 0.9f);
  same_bits(
      {kRows * kChannels, kRows * kCodes, kRows * kCodes}, [&](int threads, std::vector<std::vector<float>>& out) {
        std::vector<std::int64_t> ids(kRows);
        out[2] = logits;
        controlmm::gumbel_straight_through(
            row_major(logits.data(), {kClips, kTokens, kCodes}), row_major(codebook.data(), {kCodes, kChannels}), 0.5,
            {7, 0}, row_major(ids.data(), {kClips, kTokens}), row_major(out[0].data(), {kClips, kTokens, kChannels}),
            row_major(out[1].data(), {kClips, kTokens, kCodes}), threads);
        controlmm::softmax_backward(row_major(out[1].data(), {kRows, kCodes}), 0.5,
                                    row_major(out[2].data(), {kRows, kCodes}), threads);
      });
}

}  // namespace

int main() {
  for (const std::string& isa : controlmm::available_isas()) {
    controlmm::set_isa(isa);
    losses();
    gumbel();
  }
}
