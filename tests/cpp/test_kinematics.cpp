// recover_joints against positions worked out by hand, and against central differences.
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::row_major;
constexpr double kPi = 3.14159265358979323846;

// Two frames of two joints: a quarter turn between them, then one step forward in the new heading.
void turns_then_steps() {
  double features[2][7] = {{kPi / 4, 0, 1, 0.9, 0.3, 1.5, 0.1}, {0, 0, 0, 0.8, 0.3, 1.6, 0.1}};
  double joints[2][2][3];
  controlmm::recover_joints(row_major(&features[0][0], {1, 2, 7}), row_major(&joints[0][0][0], {1, 2, 2, 3}));
  // Half the turn is stored, so the heading turns by 90 degrees: (x, z) becomes (-z, x).
  const double expected[2][2][3] = {{{0, 0.9, 0}, {0.3, 1.5, 0.1}}, {{-1, 0.8, 0}, {-1 - 0.1, 1.6, 0.3}}};
  for (int t = 0; t < 2; ++t)
    for (int j = 0; j < 2; ++j)
      for (int c = 0; c < 3; ++c) CHECK(is_close(joints[t][j][c], expected[t][j][c], 1e-15));
}

std::vector<double> wave(std::size_t n, double step) {
  std::vector<double> values(n);
  for (std::size_t i = 0; i < n; ++i) values[i] = 0.3 * std::sin(0.7 + step * static_cast<double>(i));
  return values;
}

void gradient_matches_central_differences() {
  constexpr std::int64_t kFrames = 18, kDim = 12, kJoints = 3;
  std::vector<double> features = wave(kFrames * kDim, 0.37);
  const std::vector<double> cotangent = wave(kFrames * kJoints * 3, 1.1);
  std::vector<double> gradient(features.size());
  const auto view = row_major(features.data(), {1, kFrames, kDim});
  controlmm::recover_joints_backward(view, row_major(cotangent.data(), {1, kFrames, kJoints, 3}),
                                     row_major(gradient.data(), {1, kFrames, kDim}));
  const auto objective = [&] {
    std::vector<double> joints(cotangent.size());
    controlmm::recover_joints(view, row_major(joints.data(), {1, kFrames, kJoints, 3}));
    double total = 0;
    for (std::size_t i = 0; i < joints.size(); ++i) total += joints[i] * cotangent[i];
    return total;
  };
  for (std::size_t i = 0; i < features.size(); ++i) {
    const double kept = features[i], step = 1e-6;
    features[i] = kept + step;
    const double above = objective();
    features[i] = kept - step;
    const double below = objective();
    features[i] = kept;
    CHECK(is_close(gradient[i], (above - below) / (2 * step), 1e-7));
  }
}

// Enough clips that several threads are worth it.
void threads_give_the_same_bits() {
  constexpr std::int64_t kClips = 64, kFrames = 196, kDim = 67, kJoints = 22;
  std::vector<float> features(kClips * kFrames * kDim);
  const std::vector<double> source = wave(features.size(), 0.011);
  for (std::size_t i = 0; i < features.size(); ++i) features[i] = static_cast<float>(source[i]);
  const auto view = row_major(features.data(), {kClips, kFrames, kDim});
  std::vector<float> one(kClips * kFrames * kJoints * 3), many(one.size()), grad_one(features.size()),
      grad_many(features.size());
  const auto joints = row_major(one.data(), {kClips, kFrames, kJoints, 3});
  controlmm::recover_joints(view, joints, 1);
  controlmm::recover_joints(view, row_major(many.data(), {kClips, kFrames, kJoints, 3}), 5);
  CHECK(one == many);
  controlmm::recover_joints_backward(view, joints, row_major(grad_one.data(), {kClips, kFrames, kDim}), 1);
  controlmm::recover_joints_backward(view, joints, row_major(grad_many.data(), {kClips, kFrames, kDim}), 5);
  CHECK(grad_one == grad_many);
}

}  // namespace

int main() {
  for (const std::string& isa : controlmm::available_isas()) {
    controlmm::set_isa(isa);
    turns_then_steps();
    gradient_matches_central_differences();
    threads_give_the_same_bits();
  }
}
