// Consistency, obstacles, fused guidance and Gumbel noise through the C++ interface.
#include <cstring>
#include <memory>
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::row_major;
constexpr std::int64_t kClips = 2, kFrames = 21, kJoints = 3, kDim = 13;

std::vector<double> wave(std::size_t n, double step) {
  std::vector<double> values(n);
  for (std::size_t i = 0; i < n; ++i) values[i] = std::sin(0.3 + step * static_cast<double>(i));
  return values;
}

struct Scene {
  std::int64_t kinds[2][4] = {{0, 0, 0, 0}, {4, 0, 0, 0}};  // a ball and a floor
  double parameters[2][controlmm::kObstacleParameters] = {{0.1, 0.2, 0.3, 0.8}, {0, 1, 0, 0.1}};
  double radii[kJoints] = {0, 0.1, 0.05}, heights[1] = {0};
  bool is_active[kJoints] = {true, false, true};
  std::int64_t lengths[kClips] = {kFrames, 5};

  controlmm::Obstacles obstacles() const {
    return {row_major(&kinds[0][0], {2, 4}), row_major(&parameters[0][0], {1, 2, controlmm::kObstacleParameters, 1}),
            row_major(heights, {0})};
  }
  controlmm::Clearance clearance() const {
    return {row_major(radii, {kJoints}), row_major(is_active, {kJoints}), row_major(lengths, {kClips}), 0.05, true};
  }
};

struct Problem {
  std::vector<double> decoded = wave(kClips * kDim * kFrames, 0.41), mean = wave(kDim, 0.2), std = wave(kDim, 0.1);
  std::vector<double> targets = wave(kClips * kFrames * kJoints * 3, 0.9);
  std::unique_ptr<bool[]> mask{new bool[kClips * kFrames * kJoints * 3]};
  Scene scene;

  Problem() {
    for (std::int64_t i = 0; i < kClips * kFrames * kJoints * 3; ++i) mask[static_cast<std::size_t>(i)] = i % 4 == 0;
  }

  double value(std::vector<double>* gradient) {
    std::vector<double> own(decoded.size()), loss(kClips);
    std::vector<double>& target = gradient != nullptr ? *gradient : own;
    controlmm::guidance_value_and_grad(
        row_major(decoded.data(), {kClips, kDim, kFrames}), row_major(mean.data(), {kDim}),
        row_major(std.data(), {kDim}), row_major(targets.data(), {kClips, kFrames, kJoints, 3}),
        row_major(mask.get(), {kClips, kFrames, kJoints, 3}), controlmm::Norm::mse, scene.obstacles(),
        scene.clearance(), 0.5, row_major(loss.data(), {kClips}), row_major(target.data(), {kClips, kDim, kFrames}));
    return loss[0] + loss[1];
  }
};

void fused_gradient_matches_central_differences() {
  Problem problem;
  std::vector<double> gradient(problem.decoded.size());
  problem.value(&gradient);
  for (std::size_t i = 0; i < problem.decoded.size(); i += 3) {
    const double kept = problem.decoded[i], step = 1e-6;
    problem.decoded[i] = kept + step;
    const double above = problem.value(nullptr);
    problem.decoded[i] = kept - step;
    const double below = problem.value(nullptr);
    problem.decoded[i] = kept;
    CHECK(is_close(gradient[i], (above - below) / (2 * step), 1e-6));
  }
}

void control_alone_is_guidance_without_obstacles() {
  Problem problem;
  std::vector<double> with(problem.decoded.size()), without(problem.decoded.size()), loss(kClips), alone(kClips);
  const auto decoded = row_major(problem.decoded.data(), {kClips, kDim, kFrames});
  const auto mean = row_major(problem.mean.data(), {kDim}), std = row_major(problem.std.data(), {kDim});
  const auto targets = row_major(problem.targets.data(), {kClips, kFrames, kJoints, 3});
  const auto mask = row_major(problem.mask.get(), {kClips, kFrames, kJoints, 3});
  controlmm::Obstacles none = problem.scene.obstacles();
  none.kinds.shape[0] = none.parameters.shape[1] = 0;
  controlmm::guidance_value_and_grad(decoded, mean, std, targets, mask, controlmm::Norm::l2, none,
                                     problem.scene.clearance(), 0.5, row_major(loss.data(), {kClips}),
                                     row_major(with.data(), {kClips, kDim, kFrames}));
  controlmm::guidance_value_and_grad(decoded, mean, std, targets, mask, controlmm::Norm::l2,
                                     row_major(alone.data(), {kClips}),
                                     row_major(without.data(), {kClips, kDim, kFrames}));
  CHECK(loss == alone);
  CHECK(with == without);
  CHECK(loss[0] > 0);
}

void consistency_averages_distances() {
  const float joints[2][3] = {{0, 0, 0}, {1, 1, 1}}, targets[2][3] = {{3, 4, 0}, {1, 1, 3}};
  const bool mask[2][3] = {{true, true, true}, {true, true, true}};
  float loss = -1;
  double count = -1;
  controlmm::masked_consistency_loss(row_major(&joints[0][0], {1, 1, 2, 3}), row_major(&targets[0][0], {1, 1, 2, 3}),
                                     row_major(&mask[0][0], {1, 1, 2, 3}), controlmm::Norm::l2, row_major(&loss, {}),
                                     row_major(&count, {}));
  CHECK(is_close(loss, (5.0 + 2.0) / 2, 1e-6));
  CHECK(count == 2);
}

void noise_depends_on_its_place_only() {
  std::vector<float> whole(3 * 4 * 70), tail(1 * 4 * 70);
  controlmm::gumbel_noise({42, 0}, row_major(whole.data(), {3, 4, 70}), 3);
  controlmm::gumbel_noise({42, 2}, row_major(tail.data(), {1, 4, 70}));
  CHECK(std::memcmp(whole.data() + 2 * 4 * 70, tail.data(), tail.size() * sizeof(float)) == 0);
}

}  // namespace

int main() {
  for (const std::string& isa : controlmm::available_isas()) {
    controlmm::set_isa(isa);
    fused_gradient_matches_central_differences();
    control_alone_is_guidance_without_obstacles();
    consistency_averages_distances();
    noise_depends_on_its_place_only();
  }
}
