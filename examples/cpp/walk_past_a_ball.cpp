// A figure walks straight ahead; a ball stands in its way. Prints where the pelvis ends, how deep the joints enter the
// ball, and which way the gradient pushes the nearest joint.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <vector>

#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

constexpr std::int64_t kFrames = 60, kJoints = 22, kChannels = 263;

// Features of a stiff figure that moves 5 cm forward in each frame (20 frames a second) without turning.
std::vector<float> straight_walk() {
  std::vector<float> features(kFrames * kChannels, 0.0f);
  for (std::int64_t t = 0; t < kFrames; ++t) {
    float* frame = features.data() + t * kChannels;
    frame[2] = 0.05f;  // forward, along z
    frame[3] = 0.9f;   // height of the pelvis
    for (std::int64_t j = 1; j < kJoints; ++j) frame[4 + 3 * (j - 1) + 1] = 0.08f * static_cast<float>(j);
  }
  return features;
}

}  // namespace

int main() {
  using controlmm::row_major;
  std::printf("controlmm %s, %s, instruction set %s\n", controlmm::version(), controlmm::compiler(),
              controlmm::active_isa().c_str());

  const std::vector<float> features = straight_walk();
  std::vector<float> joints(kFrames * kJoints * 3);
  const auto joints_view = row_major(joints.data(), {1, kFrames, kJoints, 3});
  controlmm::recover_joints(row_major(features.data(), {1, kFrames, kChannels}), joints_view);
  const float* pelvis = joints.data() + (kFrames - 1) * kJoints * 3;
  std::printf("pelvis after %d frames: %.3f %.3f %.3f m\n", static_cast<int>(kFrames), pelvis[0], pelvis[1], pelvis[2]);

  // One ball of 30 cm, 1.5 m ahead and 10 cm to the side, at chest height.
  const std::int64_t kind[4] = {static_cast<std::int64_t>(controlmm::ObstacleKind::sphere), 0, 0, 0};
  const float ball[controlmm::kObstacleParameters] = {0.1f, 1.2f, 1.5f, 0.3f};
  const float radii[kJoints] = {}, no_heights[1] = {};
  const std::unique_ptr<bool[]> is_active(new bool[kJoints]);
  std::fill_n(is_active.get(), kJoints, true);
  const std::int64_t lengths[1] = {kFrames};
  const controlmm::Obstacles obstacles = {
      row_major(kind, {1, 4}), row_major(ball, {1, 1, controlmm::kObstacleParameters, 1}), row_major(no_heights, {0})};
  controlmm::Clearance clearance = {row_major(radii, {kJoints}), row_major(is_active.get(), {kJoints}),
                                    row_major(lengths, {1})};
  clearance.margin = 0.05;
  clearance.is_mean = false;

  float loss = 0, one = 1;
  controlmm::obstacle_loss(joints_view, obstacles, clearance, row_major(&loss, {1}));
  std::vector<float> gradient(joints.size());
  controlmm::obstacle_loss_backward(joints_view, obstacles, clearance, row_major(&one, {1}),
                                    row_major(gradient.data(), {1, kFrames, kJoints, 3}));
  float strongest = 0;
  for (std::size_t i = 0; i < gradient.size(); i += 3) strongest = std::max(strongest, gradient[i]);
  std::printf("sum of depths: %.3f m; largest sideways gradient: %.3f\n", loss, strongest);

  // The walk ends where 59 steps of 5 cm end. The ball is to the left (+x): moving further left goes deeper, so the
  // gradient in x is positive.
  const bool is_right = std::fabs(pelvis[2] - 2.95f) < 1e-5f && loss > 0 && strongest > 0;
  return is_right ? 0 : 1;
}
